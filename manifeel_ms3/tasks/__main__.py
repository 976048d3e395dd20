"""Show all tasks, `manifeel tasks`, or one of them, `manifeel tasks PegInsertion`."""

import inspect
import sys
from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.console import Console
from rich.markdown import Markdown
from rich.table import Table

from manifeel_ms3.command_line import run

from .registry import DESCRIPTION, PREFIX, SUFFIX, TaskSpec, all_tasks, description_of, task_spec


@dataclass
class Args:
    """Show a table of all tasks, or what one task is, what is random in it and what counts as success."""

    task: Annotated[str | None, tyro.conf.Positional] = None
    """Id or short name of a task, such as PegInsertion; a table of all tasks is shown if not given."""


def main(args: Args) -> None:
    """Print the description of a task, or the table of all tasks.

    Raises:
        UnknownNameError: There is no such task.
    """
    if args.task is None:
        table = Table("task", "category", "steps", "camera", "description", title=f'gym.make("{PREFIX}<task>{SUFFIX}")')
        for spec in all_tasks().values():
            steps = str(spec.max_episode_steps)
            table.add_row(spec.name, spec.category, steps, spec.policy_camera, _summary(spec))
        Console().print(table)
        return
    spec = task_spec(args.task)
    Console().print(Markdown(f"# {spec.env_id}\n\n{description_of(spec.env_class)}"))


def _summary(spec: TaskSpec) -> str:
    """First line of the docstring of a task's class; the task's instruction if that line is only a heading."""
    first = (inspect.getdoc(spec.env_class) or "").partition("\n")[0]
    return spec.instruction if first == DESCRIPTION else first


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
