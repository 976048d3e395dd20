"""Progress bars that show what is done, how long it took, and how long the rest will take."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

REFRESH_HZ = 2
"""Rate in Hz at which a bar is drawn; episodes take seconds."""


def progress_bar(disable: bool = False) -> Progress:
    """A progress bar for a terminal.

    Args:
        disable: Show nothing.
    """
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        refresh_per_second=REFRESH_HZ,
        disable=disable,
    )


@contextmanager
def episode_counter(
    description: str, total: int, done: int, on_episode: Callable[[], None] | None = None
) -> Iterator[Callable[[int], None]]:
    """A context with the function to call with a number of further episodes: it calls `on_episode`, or advances a progress bar.

    Args:
        description: Text beside the bar.
        total: Number of episodes.
        done: Number of episodes that are finished already.
        on_episode: Called once for each episode instead of showing a bar.
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
