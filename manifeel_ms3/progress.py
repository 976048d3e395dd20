"""Progress bars that show what is done, how long it took, and how long the rest will take."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec

import rich
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

REFRESH_HZ = 2
"""Rate in Hz at which a bar is drawn, which is enough because episodes take seconds."""


def progress_bar(disable: bool = False) -> Progress:
    """A progress bar for a terminal, or for a notebook with ipywidgets; without these, rich would warn at every bar.

    Args:
        disable: Whether nothing is shown.
    """
    in_bare_notebook = rich.get_console().is_jupyter and find_spec("ipywidgets") is None
    return Progress(
        TextColumn("{task.description}", markup=False),  # it may hold the name of a file
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        refresh_per_second=REFRESH_HZ,
        disable=disable or in_bare_notebook,
    )


@contextmanager
def episode_counter(
    description: str, total: int, done: int, on_episode: Callable[[], None] | None = None
) -> Iterator[Callable[[int], None]]:
    """Context manager that yields a function, which is to be called with the number of episodes that have just finished.

    The function advances a progress bar, or calls `on_episode` if that is given.

    Args:
        description: Text beside the bar.
        total: Number of episodes.
        done: Number of episodes that are finished already.
        on_episode: Function that is called once for each episode; a progress bar is shown if it is not given.
    """
    if on_episode is not None:
        yield partial(_repeat, on_episode)
        return
    with progress_bar() as bar:
        task = bar.add_task(description, total=total, completed=done)
        yield lambda number: bar.advance(task, number)


def _repeat(function: Callable[[], None], number: int) -> None:
    for _ in range(number):
        function()
