"""The policies that can be trained, by their registered names.

A policy is registered through the entry point group `manifeel.policies`; the baselines register theirs in `pyproject.toml` as
another package would. A checkpoint names its policy by the registered name, and nothing that a checkpoint says is imported.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from manifeel_ms3 import plugins
from manifeel_ms3.command_line import as_typed, missing_extras_named
from manifeel_ms3.errors import PluginError, UnknownNameError

from . import tactile_representations as tactile_representations  # registers its encoders for every policy
from .common.agent import PolicyAgent
from .common.policy import VisuotactilePolicy
from .common.presets import in_epochs, with_noisy_pose, with_targets
from .common.train_args import TrainArgs


@dataclass(frozen=True)
class Preset:
    """Named settings of a training run, from which a user can start."""

    about: str
    """What the settings are for, in a few words."""
    args: TrainArgs
    """The settings."""


def small_presets(cpu: TrainArgs) -> dict[str, Preset]:
    """The presets of small networks, by name.

    Args:
        cpu: Settings of the preset `cpu`, from which the others follow.
    """
    longer = in_epochs(cpu)
    return {
        "cpu": Preset("A small network that learns on a CPU core in minutes.", cpu),
        "cpu_long": Preset("The preset `cpu`, for longer on long tasks, and with less noise on the pose.", longer),
        "cpu_targets": Preset(
            "The preset `cpu_long`, with the hand's pose predicted instead of motions.", with_targets(longer)
        ),
        "cpu_noisy_pose": Preset(
            "The preset `cpu_targets`, with 8,000 gradient steps and ten times the noise on the pose.",
            with_noisy_pose(with_targets(cpu)),
        ),
    }


@dataclass(frozen=True)
class PolicySpec:
    """A policy that can be trained, evaluated and named by a study."""

    policy_class: type[VisuotactilePolicy]
    """The policy; its attribute `name` is the registered name."""
    args_class: type[TrainArgs]
    """Arguments of its training; a class of its own."""
    presets: dict[str, Preset]
    """Settings by name; the first is the paper's."""

    @property
    def name(self) -> str:
        """The registered name, such as "diffusion_policy"."""
        return self.policy_class.name

    def train(self, args: TrainArgs) -> Path:
        """Train, and return the last checkpoint.

        Raises:
            PluginError: The policy names another class of settings than its arguments have, so that its checkpoints could not
                be read.
            MissingExtraError: Training needs an optional dependency that is not installed.
        """
        given, named = type(args.policy), self.policy_class.Config
        if given is not named:
            raise PluginError(
                f"the settings of the policy {self.name!r} are of the class {given.__qualname__}, and its checkpoints would be "
                f"read as {named.__qualname__}; give the class {self.policy_class.__qualname__} the line "
                f"`Config = {given.__qualname__}`"
            )
        with missing_extras_named():
            from .common.training import train  # imported here, because it takes seconds

        return train(args, self.policy_class)

    def load(self, checkpoint: Path, **kwargs: Any) -> PolicyAgent:
        """The trained policy of a checkpoint, as evaluation asks for it."""
        return PolicyAgent(checkpoint, self.policy_class, **kwargs)


def all_policies() -> dict[str, PolicySpec]:
    """Every registered policy that these baselines can train, by its name; plug-ins that do not import are left out.

    Raises:
        PluginError: A policy is registered under another name than its own, or two policies share a class of arguments.
    """
    plugged, _ = plugins.load_all(plugins.POLICIES)
    specs = {name: spec for name, spec in plugged.items() if isinstance(spec, PolicySpec)}
    require_distinct(specs)
    return specs


def require_distinct(specs: dict[str, PolicySpec]) -> None:
    """Check that registered names and classes of arguments each belong to one policy.

    Raises:
        PluginError: A policy is registered under another name than its own, or two policies share a class of arguments.
    """
    owners: dict[type[TrainArgs], str] = {}
    for name, spec in specs.items():
        if spec.name != name:
            raise PluginError(
                f"the policy {spec.name!r} is registered as {name!r} in {plugins.POLICIES}; register it as {spec.name!r}"
            )
        other = owners.setdefault(spec.args_class, name)
        if other != name:
            raise PluginError(
                f"the policies {other!r} and {name!r} share the class of arguments {spec.args_class.__qualname__}, by which "
                "`manifeel train` tells policies apart; give each policy a subclass of TrainArgs of its own"
            )


def policy_spec(name: str) -> PolicySpec:
    """A registered policy.

    Raises:
        UnknownNameError: No policy of this name can be trained; the message lists those that can.
        PluginError: The plug-in of this name does not import.
    """
    if name in plugins.registered(plugins.POLICIES):
        plugins.load(plugins.POLICIES, name)
    if name not in (known := all_policies()):
        raise UnknownNameError(f"the policy {name!r} is not registered; registered are {list(known)}")
    return known[name]


def next_step(_args: TrainArgs, made: Path) -> str:
    """What training made, and what one can do with it."""
    return f"{made} is the trained policy; {as_typed('manifeel', 'eval', '--checkpoint', made)} evaluates it"


def preset_cli(spec: PolicySpec, args: list[str] | None = None) -> Any:
    """Training arguments of a policy from the command line, which begins with a preset's name.

    Args:
        spec: The policy.
        args: The arguments; those of the process if not given.
    """
    presets = {name: (preset.about, preset.args) for name, preset in spec.presets.items()}
    return tyro.extras.overridable_config_cli(presets, args=args)
