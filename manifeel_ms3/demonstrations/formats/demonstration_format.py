"""What this package needs to know of a format in which demonstrations are stored."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.tasks.obs_modes import POSE

Demonstration = dict[str, np.ndarray]
"""Arrays of one episode: "actions" (T, A), and observations (T + 1, ...) by their keys, such as "sensor_data/wrist/rgb"."""
Progress = Callable[[Any], Iterable[int]]
"""Function that wraps a sequence of episode numbers to show a progress bar; `iter` shows none."""
MAX_COMPRESSION = 1032
"""Largest ratio by which gzip's deflate compresses (zlib's technical details, zlib.net/zlib_tech.html). An array that claims to
be larger than its stored bytes times this ratio is refused before it is read."""


POSE_SIZE = 7
"""Number of entries of a pose: 3 of the position, 4 of the quaternion."""


class DemonstrationError(InvalidFileError):
    """A file or folder of demonstrations cannot be used as asked."""


def require_form(name: str, key: str, shape: tuple[int, ...]) -> None:
    """Check that an array holds a pose, an image with three channels, or a force field with three components at each step.

    Args:
        name: Name of the array, for the message.
        key: Observation that the array holds.
        shape: Shape of the array; the first axis counts steps.

    Raises:
        DemonstrationError: The array has another shape.
    """
    expected = (POSE_SIZE,) if key == POSE else ("height", "width", 3) if key.endswith("/rgb") else ("rows", "columns", 3)
    found = shape[1:]
    if len(found) != len(expected) or found[-1] != expected[-1]:
        raise DemonstrationError(
            f"{name} has the shape {found} at a step, expected {expected}"
            + (", the position and a quaternion" if key == POSE else "")
            + "; record or export it again"
        )


class ReadEpisodes(Protocol):
    """Function that reads episodes."""

    def __call__(
        self, path: Path, keys: list[str], /, *, num: int | None = None, progress: Progress = iter, env_id: str | None = None
    ) -> Iterator[Demonstration]:
        """The first episodes of a file or folder, each of which is read when it is asked for.

        Args:
            path: File or folder.
            keys: Observations to read, such as "sensor_data/wrist/rgb", "extra/tcp_pose".
            num: Number of episodes; all of them if not given.
            progress: Wraps the iteration over episodes.
            env_id: Id of the task that the episodes must be of. Formats that do not hold the task ignore it.

        Raises:
            DemonstrationError: The data is missing or broken, lacks one of the keys, has fewer episodes or another task.
            MissingExtraError: The library that reads the format is not installed.
        """
        ...


@dataclass(frozen=True)
class DemonstrationFormat:
    """One format of demonstrations."""

    name: str
    """Name on the command line, such as "lerobot"."""
    matches: Callable[[Path], bool]
    """Function that tells whether a file or folder is of this format, from the names of the files in it."""
    count: Callable[[Path], int]
    """Function that returns the number of episodes in a file or folder."""
    read: ReadEpisodes
    """Function that reads episodes."""
    write: Callable[[Path, Path, Progress], None] | None = None
    """Function that writes the episodes of a trajectory file (first path) into a new folder (second path); None for a format
    that only recording writes."""
    env_kwargs: Callable[[Path], dict[str, Any] | None] | None = None
    """Function that returns the arguments of the environment with which the episodes were recorded, or None if a file does not
    hold them. The field itself is None for a format that never holds them."""
    env_id: Callable[[Path], str | None] | None = None
    """Function that returns the id of the task that a file names, or None if it names none. The field itself is None for a
    format that never does."""
