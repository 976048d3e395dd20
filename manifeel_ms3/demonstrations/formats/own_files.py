"""A data set in a folder reads files of that folder alone, wherever the folder came from."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from manifeel_ms3.errors import ManifeelError

from .demonstration_format import DemonstrationError


def stored_bytes(folder: Path) -> dict[Path, int]:
    """Sizes of all files in a folder, by their paths.

    Raises:
        DemonstrationError: A link in the folder leads out of it, or something in it is no plain file (a pipe, a device).
    """
    folder, sizes = Path(folder), {}
    inside = folder.resolve()
    for parent, folders, files in os.walk(folder):
        for path in (Path(parent) / name for name in (*folders, *files)):
            if path.is_symlink() and not path.resolve().is_relative_to(inside):
                raise DemonstrationError(f"{path} is a link out of {folder}; copy the data set without links (`cp -rL`)")
            if path.is_file():
                sizes[path] = path.stat().st_size
            elif not path.is_dir():
                raise DemonstrationError(f"{path} is no plain file; get the data set again from its source")
    return sizes


@contextmanager
def broken_if_fails(folder: Path, what: str) -> Iterator[None]:
    """Turn whatever a library raises over broken data into an error that names the folder.

    Args:
        folder: Folder of the data set.
        what: What is read, for the message: "the data".

    Raises:
        DemonstrationError: The code inside failed.
    """
    try:
        yield
    except ManifeelError:
        raise
    except Exception as error:  # numcodecs, pyarrow and ffmpeg raise many kinds
        raise DemonstrationError(
            f"{folder}: {what} cannot be read ({type(error).__name__}: {error}); copy or export the data set again"
        ) from error
