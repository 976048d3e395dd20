"""The tasks: `python -m manifeel_ms3.tasks`, or one of them, `python -m manifeel_ms3.tasks PegInsertion`."""

import inspect
import sys
from dataclasses import dataclass
from typing import Annotated

import gymnasium as gym
import tyro
from mani_skill.utils.registration import REGISTERED_ENVS
from rich.console import Console
from rich.markdown import Markdown
from rich.table import Table

from manifeel_ms3.command_line import run

from .names import PREFIX, SUFFIX, short_name


@dataclass
class Args:
    task: Annotated[str | None, tyro.conf.Positional] = None
    """id or short name, such as PegInsertion: what it is, what is random, what counts as success; default: all, in a table"""


def main(args: Args) -> None:
    """Print them.

    Raises:
        ValueError: there is no such task.
    """
    tasks = {name: spec.cls for name, spec in REGISTERED_ENVS.items() if name.startswith(PREFIX)}
    short = {short_name(name): name for name in tasks}
    if args.task is None:
        table = Table("task", "steps", "camera", "what is to be done", title=f'gym.make("{PREFIX}<task>{SUFFIX}")')
        for task, name in short.items():
            cls = tasks[name]
            table.add_row(task, str(gym.spec(name).max_episode_steps), ", ".join(cls.policy_cameras), _description(cls))
        Console().print(table)
        return
    name = short.get(args.task, args.task)
    if name not in tasks:
        raise ValueError(f"there is no task {args.task!r}; choose from {list(short)}")
    Console().print(Markdown(f"# {name}\n\n{inspect.getdoc(tasks[name])}"))


def _description(cls: type) -> str:
    """The first paragraph."""
    text = (inspect.getdoc(cls) or "").removeprefix("**Task Description:**")
    return " ".join(text.partition("\n\n")[0].split())


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
