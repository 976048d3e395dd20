"""Checks of data sets in folders: they only read files of their folder, wherever it came from, and are of the task."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from manifeel_ms3.errors import InvalidFileError, ManifeelError
from manifeel_ms3.files import read_json
from manifeel_ms3.tasks.registry import other_revision

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


def read_origin(path: Path, schema: dict[str, Any], what: str, advice: str) -> dict[str, Any]:
    """What a data set says about the task that was recorded, such as `env_id` and `env_kwargs`; {} if it says nothing.

    Args:
        path: Path of the json file, which need not exist.
        schema: Json schema of the file.
        what: What the file is, for the message.
        advice: What to do about a broken file, for the message.

    Raises:
        DemonstrationError: The file is broken.
    """
    try:
        return read_json(path, schema, what) if path.is_file() else {}
    except InvalidFileError as error:
        raise DemonstrationError(f"{error}; {advice}") from error


def require_task(path: Path, origin: dict[str, Any], env_id: str | None) -> None:
    """Check that a file or folder is of a task as it is now, if one is asked for and it names its own.

    Args:
        path: Path of the file or folder.
        origin: What it says of its origin: `env_id` and `revision` of its task, either of which may be missing.
        env_id: Id of the task that is asked for; any task in any revision if None.

    Raises:
        DemonstrationError: It is of another task, or of another revision of the task.
    """
    if env_id is None:
        return
    if (found := origin.get("env_id", env_id)) != env_id:
        raise DemonstrationError(
            f"{path} holds demonstrations of {found}, not of {env_id}; ask for {found}, or give those of {env_id}"
        )
    require_revision(path, env_id, origin.get("revision"))


def require_revision(path: Path, env_id: str, recorded: int | None) -> None:
    """Check that a task has not changed since it was recorded or evaluated.

    Args:
        path: Path of the recording or the result, for the message.
        env_id: Id of the task.
        recorded: Revision of the task at that time; None if that is not known, which passes.

    Raises:
        DemonstrationError: The task has another revision now.
        UnknownNameError: The task is not registered.
    """
    if fault := other_revision(env_id, recorded):
        raise DemonstrationError(f"{path}: {fault}; make it again, or use the version of manifeel-ms3 that made it")


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
    except Exception as error:  # numcodecs, pyarrow and ffmpeg raise errors of many types
        raise DemonstrationError(
            f"{folder}: {what} cannot be read ({type(error).__name__}: {error}); copy or export the data set again"
        ) from error
