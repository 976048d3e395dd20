"""`manifeel`: every command of the package in one place.

    manifeel record ManiFeel-PegInsertion-v1 -n 50 --out peg.h5
    manifeel train diffusion_policy cpu --demo-path peg.h5
    manifeel --tyro-print-completion bash > ~/.local/share/bash-completion/completions/manifeel

Each command is a module with a class `Args` and a function `main(args)`, and can also be run by itself (`python -m`). If the
module has a function `next_step(args, answer)`, the text that it returns is shown at the end. Other packages add commands
through the entry point group `manifeel.commands`. Only the module of the command that is run is imported, except for a shell's
completion, which needs the flags of all commands.
"""

import logging
import sys
from dataclasses import dataclass
from functools import cache, partial, reduce
from importlib import import_module
from importlib.metadata import version
from operator import or_
from typing import Annotated, Any

import tyro

from manifeel_ms3 import plugins
from manifeel_ms3.arguments import meant
from manifeel_ms3.command_line import missing_extras_named, run
from manifeel_ms3.errors import PluginError, UnknownNameError
from manifeel_ms3.plugins import Command
from manifeel_ms3.typed_modules import import_typed_tasks

log = logging.getLogger(__name__)
COMMANDS = {
    "tasks": Command("manifeel_ms3.tasks.__main__", "List the tasks, or describe one of them."),
    "doctor": Command("manifeel_ms3.doctor", "Check what this machine can do, and how to repair what it cannot."),
    "record": Command("manifeel_ms3.demonstrations.record", "Record a scripted demonstrator."),
    "teleop": Command("manifeel_ms3.teleop.__main__", "Record demonstrations by hand, in a browser."),
    "dataset": Command("manifeel_ms3.demonstrations.dataset", "Record as many demonstrations of every task as the paper."),
    "replay": Command("manifeel_ms3.demonstrations.replay", "Run recorded actions again."),
    "render-observations": Command("manifeel_ms3.demonstrations.render_observations", "Add observations to recorded states."),
    "validate": Command("manifeel_ms3.demonstrations.validate", "Check recorded files for errors."),
    "view": Command("manifeel_ms3.demonstrations.view", "Look at a recorded episode in Rerun."),
    "film": Command("manifeel_ms3.videos.__main__", "Make a video of recorded or evaluated episodes."),
    "summary": Command("manifeel_ms3.demonstrations.summary", "Summarize the content of a recorded file."),
    "export": Command("manifeel_ms3.demonstrations.export", "Export demonstrations to LeRobot, the paper's zarr, or npz."),
    "eval": Command("manifeel_ms3.evaluation.evaluate", "Evaluate a policy on fixed seeds."),
    "report": Command("manifeel_ms3.evaluation.report", "Write a page about one training run."),
    "results": Command("manifeel_ms3.analysis.results_page", "Write a page of all results beside the paper's numbers."),
    "claims": Command("manifeel_ms3.analysis.claims", "Test the paper's claims on your results."),
    "leaderboard": Command("manifeel_ms3.leaderboard.__main__", "Hash or check a submission, or build the leaderboard's page."),
    "verify-sensor": Command("manifeel_ms3.verification.__main__", "Verify a tactile sensor by known loads."),
    "similarity": Command("manifeel_ms3.analysis.sim_real_similarity", "Measure how similar simulated and real touch are."),
    "audit": Command(
        "manifeel_ms3.analysis.information_audit", "Measure how much a camera, TacRGB and TacFF reveal in each task."
    ),
}
"""The package's own commands by their names."""


@dataclass
class _NotImported:
    """Stands for the arguments of a command whose module is not imported, because only its name is listed."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code.

    Args:
        arguments: The command's name and its arguments; those of the process if not given.
    """
    return run(_run, sys.argv[1:] if arguments is None else arguments)


@cache
def all_commands() -> dict[str, Command]:
    """The package's own commands, followed by those of plug-ins, by their names.

    Raises:
        PluginError: A plug-in does not import, is not a `Command`, or has the name of one of the package's own commands.
    """
    return COMMANDS | {name: _of_plugin(name) for name in plugins.registered(plugins.COMMANDS)}


def _of_plugin(name: str) -> Command:
    command = plugins.load(plugins.COMMANDS, name)
    if not isinstance(command, Command):
        raise PluginError(f"the plug-in command {name!r} is {command!r}; it must be a manifeel_ms3.plugins.Command")
    if name in COMMANDS:
        raise PluginError(f"the plug-in command {name!r} ({command.module}) has the name of one of manifeel's own; rename it")
    return command


def _command(name: str) -> Command | None:
    """The command of a name, without the import of other plug-ins, which may be broken; None if there is none."""
    if name in COMMANDS:
        return COMMANDS[name]
    return _of_plugin(name) if name in plugins.registered(plugins.COMMANDS) else None


def _run(arguments: list[str]) -> Any:
    if arguments == ["--version"]:
        sys.stdout.write(f"manifeel-ms3 {version('manifeel-ms3')}\n")
        return None
    if arguments and (command := _command(name := arguments[0])):
        module = _module_of(command)
        parse = getattr(module, "parse", partial(_parsed, name, command.about, module.Args))
        args = parse(arguments[1:])
        import_typed_tasks(args)
        answer = module.main(args)
        if hasattr(module, "next_step"):
            log.info("%s", module.next_step(args, answer))
        return answer
    commands = all_commands()
    if arguments and not arguments[0].startswith("-"):
        raise UnknownNameError(
            f"{arguments[0]!r} is not a command; choose from {list(commands)}{meant(arguments[0], commands)}"
        )
    completion = any("-completion" in argument for argument in arguments)
    forms: list[Any] = [
        Annotated[
            _module_of(command).Args if completion else _NotImported, tyro.conf.subcommand(name, description=command.about)
        ]
        for name, command in commands.items()
    ]
    choice: Any = reduce(or_, forms)
    tyro.cli(choice, prog="manifeel", args=arguments)  # prints the list, a completion, or an error
    return None


def _parsed(name: str, about: str, form: Any, arguments: list[str]) -> Any:
    return tyro.cli(form, prog=f"manifeel {name}", description=about, args=arguments)


def command_module(name: str) -> Any:
    """The module of the command of a name, with its `Args` and `main`.

    Raises:
        PluginError: A plug-in does not import, is not a `Command`, or has the name of one of the package's own commands.
        MissingExtraError: The module needs an optional dependency that is not installed.
    """
    return _module_of(all_commands()[name])


def _module_of(command: Command) -> Any:
    with missing_extras_named():
        return import_module(command.module)


if __name__ == "__main__":
    sys.exit(main())
