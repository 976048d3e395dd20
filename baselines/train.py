"""Train any registered policy: `manifeel train diffusion_policy cpu --demo-path peg.h5`."""

import sys
from collections.abc import Mapping
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any

import tyro

from baselines.common.train_args import TrainArgs
from baselines.registry import PolicySpec, Preset, all_policies, next_step
from manifeel_ms3 import plugins
from manifeel_ms3.arguments import meant
from manifeel_ms3.command_line import run
from manifeel_ms3.errors import InvalidArgumentError


def _form(spec: PolicySpec) -> Any:
    """The presets of a policy, as a subcommand that tyro can read."""
    args = {name: preset.args for name, preset in spec.presets.items()}
    about = {name: preset.about for name, preset in spec.presets.items()}
    settings = tyro.extras.subcommand_type_from_defaults(args, about)
    description = (spec.policy_class.__doc__ or "").partition("\n")[0]
    return Annotated[settings, tyro.conf.subcommand(spec.name, description=description)]


Args = reduce(or_, map(_form, all_policies().values()))


ONLY_IN_MANISKILL = {
    "--control-mode": "it is that of the demonstrations",
    "--sim-backend": "it is that of the demonstrations",
    "--demo-type": "nothing depends on it",
    "--max-episode-steps": "it is the task's; --eval-env-kwargs '{\"max_episode_steps\": 300}' gives another to evaluations",
}
"""Flags of the scripts of ManiSkill's baselines that training does not take, and why."""


def parse(arguments: list[str]) -> TrainArgs:
    """The settings of a command line, read with the flags of its policy and preset alone; tyro would list those of all presets.

    Args:
        arguments: The command line after `manifeel train`.

    Raises:
        InvalidArgumentError: The name of the policy or of the preset is missing or misspelt, or a flag is one that only
            ManiSkill's scripts have.
        PluginError: The policy's plug-in does not import.
    """
    policy, preset = ([name.replace("-", "_") for name in arguments] + ["", ""])[:2]
    asks_for_help = bool({"-h", "--help"} & set(arguments))
    if policy.startswith("__tyro") or (asks_for_help and preset not in _presets_of(policy)):
        return tyro.cli(Args, prog="manifeel train", args=arguments)
    if policy in plugins.registered(plugins.POLICIES):
        plugins.load(plugins.POLICIES, policy)  # says why a broken one does not import
    if policy not in all_policies():
        raise InvalidArgumentError(
            f"`manifeel train` needs the name of a policy before that of a preset; choose from {list(all_policies())}"
            f"{meant(policy, all_policies())}"
        )
    if preset not in (presets := _presets_of(policy)):
        choices = "; ".join(f"{name} ({about.about.rstrip('.')})" for name, about in presets.items())
        is_name = preset.strip("_") == preset != ""
        wrong = f"has no preset {preset!r}" if is_name else "needs the name of a preset before its flags"
        raise InvalidArgumentError(f"`manifeel train {policy}` {wrong}; choose from {choices}{meant(preset, presets)}")
    for name in (argument.partition("=")[0].replace("_", "-") for argument in arguments):
        if name in ONLY_IN_MANISKILL:
            raise InvalidArgumentError(f"{name} is a flag of ManiSkill's baselines; leave it out: {ONLY_IN_MANISKILL[name]}")
    chosen = presets[preset]
    names = f"manifeel train {policy} {preset}"
    return tyro.cli(type(chosen.args), default=chosen.args, prog=names, description=chosen.about, args=arguments[2:])


def _presets_of(policy: str) -> Mapping[str, Preset]:
    return spec.presets if (spec := all_policies().get(policy)) else {}


def main(args: TrainArgs) -> Path:
    """Train the policy to which the arguments belong, and return the last checkpoint."""
    (spec,) = [spec for spec in all_policies().values() if type(args) is spec.args_class]
    return spec.train(args)


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
