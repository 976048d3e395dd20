"""Folders of the data that ships with the package, and of assets that are derived from it once, such as simplified meshes."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import platformdirs

from .errors import MachineError
from .files import FileWriteError, atomic_write, failures_named

CACHE_DIR = "MANIFEEL_CACHE_DIR"
"""Environment variable that names the folder of derived assets."""
_PACKAGE = Path(__file__).resolve().parent

CHECKPOINTS = "checkpoints"
"""Name of the folder of checkpoints, in the folder of a training run and beside a published result."""
EVALUATION = "evaluation.json"
"""Name of the result of the checkpoint that was evaluated last, in the folder of a training run."""
LAST_LINK = "last"
"""Name of the link, in that folder, to the checkpoint from which training continues; it always leads to a complete one."""


def data_dir() -> Path:
    """Folder of the data that ships with the package: `manifeel_ms3/data` in a wheel, `data` in a clone."""
    packaged = _PACKAGE / "data"
    return packaged if packaged.is_dir() else _PACKAGE.parent / "data"


def leaderboard_dir() -> Path:
    """Folder `leaderboard` in the working folder, or else in the clone that this package is imported from."""
    here = Path("leaderboard")
    return here if here.is_dir() else _PACKAGE.parent / "leaderboard"


def troubleshooting() -> Path:
    """Path of the page that explains errors: beside the data in a wheel, in `docs` in a clone."""
    packaged = _PACKAGE / "data" / "troubleshooting.md"
    return packaged if packaged.is_file() else _PACKAGE.parent / "docs" / "troubleshooting.md"


def cache_dir() -> Path:
    """Folder of derived assets: the user's cache, unless the environment variable `MANIFEEL_CACHE_DIR` names another.

    Raises:
        MachineError: The user has no home folder, and the variable is not set.
    """
    folder = Path(os.environ.get(CACHE_DIR) or platformdirs.user_cache_dir("manifeel_ms3"))
    if folder.parts[0] == "~":  # it was not expanded: the user has no home folder
        raise MachineError(f"there is no home folder to keep derived files in; set {CACHE_DIR} to a folder that can be written")
    return folder


@contextmanager
def writable_cache() -> Iterator[Path]:
    """Context manager that makes and yields the folder of derived assets; if writing fails, the error names the remedy.

    Raises:
        MachineError: The folder cannot be made, or the code in the context cannot write into it.
    """
    folder = cache_dir()
    try:
        with failures_named(folder):
            folder.mkdir(parents=True, exist_ok=True)
        with failures_named(folder, inside=folder):
            yield folder
    except FileWriteError as error:
        raise MachineError(
            f"derived files cannot be kept in {folder} ({error.__cause__}); set {CACHE_DIR} to a folder that can be written"
        ) from error


def derived_file(name: str, make: Callable[[], str | bytes]) -> Path:
    """Path of a file among the derived assets, which is made where it is missing.

    Args:
        name: Path of the file in the folder of derived assets.
        make: Function that returns the content, as a text or as bytes.

    Raises:
        MachineError: The file cannot be written.
    """
    path = cache_dir() / name
    if not path.is_file():
        with writable_cache(), atomic_write(path) as partial:
            content = make()
            partial.write_bytes(content.encode() if isinstance(content, str) else content)
    return path
