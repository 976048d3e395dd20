"""Progress bars that show what is done, how long it took and how long it will."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


def progress_bar(disable: bool = False) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        refresh_per_second=2,
        disable=disable,
    )


@contextmanager
def episode_counter(
    description: str, total: int, done: int, on_episode: Callable[[], None] | None = None
) -> Iterator[Callable[[], None]]:
    """What to call after each episode: `on_episode`, or else a progress bar's advance."""
    if on_episode is not None:
        yield on_episode
        return
    with progress_bar() as bar:
        task = bar.add_task(description, total=total, completed=done)
        yield lambda: bar.advance(task)
