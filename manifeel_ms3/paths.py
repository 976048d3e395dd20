"""Folders of the data that ships with the package, and of derived assets."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import platformdirs

from .errors import MachineError

_PACKAGE = Path(__file__).resolve().parent


def data_dir() -> Path:
    """Folder of the data that ships with the package: `manifeel_ms3/data` in a wheel, `data` in a clone."""
    packaged = _PACKAGE / "data"
    return packaged if packaged.is_dir() else _PACKAGE.parent / "data"


def troubleshooting() -> Path:
    """Path of the page that explains errors: beside the data in a wheel, in `docs` in a clone."""
    packaged = _PACKAGE / "data" / "troubleshooting.md"
    return packaged if packaged.is_file() else _PACKAGE.parent / "docs" / "troubleshooting.md"


def cache_dir() -> Path:
    """Folder of derived assets: the user's cache, unless the environment variable `MANIFEEL_CACHE_DIR` names another."""
    return Path(os.environ.get("MANIFEEL_CACHE_DIR") or platformdirs.user_cache_dir("manifeel_ms3"))


@contextmanager
def writing_to_cache() -> Iterator[None]:
    """Context in which files are written to `cache_dir()`.

    Raises:
        MachineError: The folder cannot be written, as where the home folder does not exist.
    """
    try:
        yield
    except OSError as error:
        raise MachineError(
            f"the folder of derived assets, {cache_dir()}, cannot be written ({error}); set the environment variable "
            "MANIFEEL_CACHE_DIR to a folder that can"
        ) from error
