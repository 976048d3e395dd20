"""Folders of the data that ships with the package, and of derived assets."""

import os
from pathlib import Path

import platformdirs

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
