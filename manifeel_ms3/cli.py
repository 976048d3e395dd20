"""`manifeel`: every command of the package in one place.

    manifeel record ManiFeel-PegInsertion-v1 -n 50 --out trajectory.h5
    manifeel train diffusion_policy cpu --demos trajectory.h5
    manifeel --tyro-print-completion bash > ~/.local/share/bash-completion/completions/manifeel

Each is a module that can be run by itself (`python -m`), with an `Args` and a `main` that takes it. Only the one that is asked
for is imported; a shell's completion, though, knows the flags of all.
"""

import sys
from dataclasses import dataclass
from functools import reduce
from importlib import import_module
from operator import or_
from pathlib import Path
from typing import Annotated, Any

import tyro

from manifeel_ms3.command_line import run

TRAIN = "train"
COMMANDS = {
    "tasks": ("manifeel_ms3.tasks.__main__", "list the tasks, or say what one is"),
    "doctor": ("manifeel_ms3.doctor", "what this machine can do, and how to mend what it cannot"),
    "record": ("manifeel_ms3.demonstrations.record", "record a demonstrator"),
    "teleop": ("manifeel_ms3.teleop.__main__", "record by hand, in a browser"),
    "dataset": ("manifeel_ms3.demonstrations.dataset", "record the paper's number of demonstrations of every task"),
    "replay": ("manifeel_ms3.demonstrations.replay", "run recorded actions again"),
    "materialize": ("manifeel_ms3.demonstrations.materialize", "add observations to recorded states"),
    "validate": ("manifeel_ms3.demonstrations.validate", "check recorded files"),
    "view": ("manifeel_ms3.demonstrations.view", "look at a recorded episode"),
    "summary": ("manifeel_ms3.demonstrations.summary", "what a recorded file holds"),
    "export": ("manifeel_ms3.demonstrations.export", "write LeRobot, the paper's zarr, or npz"),
    TRAIN: ("baselines", "train a policy"),
    "eval": ("manifeel_ms3.evaluation.run", "evaluate a policy on fixed seeds"),
    "report": ("manifeel_ms3.evaluation.report", "a page about one run"),
    "matrix": ("manifeel_ms3.evaluation.matrix.__main__", "record, train and evaluate a whole study"),
    "results": ("manifeel_ms3.evaluation.results", "a page of all that was run, beside the paper's figures"),
    "claims": ("manifeel_ms3.evaluation.claims", "the paper's claims, from what was run"),
    "leaderboard": ("manifeel_ms3.evaluation.leaderboard.__main__", "check a submission, build the page"),
    "similarity": ("manifeel_ms3.evaluation.similarity", "how near simulated touch is to real touch"),
    "audit": ("manifeel_ms3.evaluation.audit", "what each sense can tell in each task"),
}


@dataclass
class _NotImported:
    """A command in the list of all."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit code.

    Args:
        arguments: default: those of the process.
    """
    return run(_run, sys.argv[1:] if arguments is None else arguments)


def _run(arguments: list[str]) -> Any:
    if arguments and arguments[0] in COMMANDS:
        args = tyro.cli(form(arguments[0]), prog=f"manifeel {arguments[0]}", args=arguments[1:])
    else:
        wanted = any("-completion" in argument for argument in arguments)
        forms = [_subcommand(name, form(name) if wanted else _NotImported, about) for name, (_, about) in COMMANDS.items()]
        args = tyro.cli(reduce(or_, forms), prog="manifeel", args=arguments)
    return import_module(type(args).__module__).main(args)


def form(command: str) -> Any:
    """What tyro reads a command's arguments into."""
    module = import_module(COMMANDS[command][0])
    if command != TRAIN:
        return module.Args
    forms = []
    for folder in sorted(path.parent for path in Path(module.__path__[0]).glob("*/train.py")):
        train = import_module(f"baselines.{folder.name}.train")
        presets = {name: args for name, (_, args) in train.PRESETS.items()}
        about = {name: text for name, (text, _) in train.PRESETS.items()}
        settings = tyro.extras.subcommand_type_from_defaults(presets, about)
        forms.append(_subcommand(folder.name, settings, str(train.__doc__).partition("\n")[0]))
    return reduce(or_, forms)


def _subcommand(name: str, form: Any, about: str) -> Any:
    return Annotated[form, tyro.conf.subcommand(name, description=about)]


if __name__ == "__main__":
    sys.exit(main())
