"""Reading and writing of files: a file that is written appears whole or not at all, whenever the program is killed."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

import jsonschema

from .errors import InvalidFileError, ManifeelError

PARTIAL = ".partial"
"""End of the name of a file or folder that is being written, or deleted."""
SHOWN_LENGTH = 200
"""Number of characters of a schema's complaint that an error message shows; the complaint quotes the whole content."""


class FileWriteError(ManifeelError, OSError):
    """A file cannot be written: its folder is read-only or is a file, the disk is full, or a permission is missing."""


@contextmanager
def _failures_named(path: Path) -> Iterator[None]:
    """Turn a failure of the file system into an error that names the path which is written."""
    try:
        yield
    except OSError as error:
        raise FileWriteError(
            f"{path} cannot be written ({error}); make room or get the permission, or give another path"
        ) from error


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Replace a file as a whole once the context has written the temporary path that it is given.

    The temporary file is in the same folder, which is made where it does not exist. It reaches the disk before it takes the
    place of the old file, and is removed where the context fails; the old file then stays as it was.

    Args:
        path: Path of the file to write.

    Raises:
        FileWriteError: The file cannot be written; the message has the path and the reason.
    """
    path = Path(path)
    partial = path.with_name(path.name + PARTIAL)
    try:
        with _failures_named(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield partial
            _flush(partial)
            partial.replace(path)
            _flush(path.parent)
    finally:
        if partial.is_file():
            partial.unlink()


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Make a folder that appears as a whole once the context has filled the temporary folder that it is given.

    Args:
        path: Path of the folder, which must not exist, or be empty. Its parent folder is made where it does not exist.

    Raises:
        FileWriteError: The folder cannot be written; the message has the path and the reason.
    """
    path = Path(path)
    partial = _hidden(path)
    try:
        with _failures_named(path):
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
            yield partial
            for entry in (*partial.rglob("*"), partial):
                _flush(entry)
            partial.rename(path)
            _flush(path.parent)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _hidden(path: Path) -> Path:
    """Path of a folder while it is written."""
    return path.with_name(f".{path.name}{PARTIAL}")


def write_text(path: Path, text: str) -> None:
    """Write a text file as a whole.

    Raises:
        FileWriteError: The file cannot be written.
    """
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Any) -> None:
    """Write a json file as a whole.

    Raises:
        FileWriteError: The file cannot be written.
    """
    write_text(path, json.dumps(content, indent=2))


def read_json(path: Path, schema: dict[str, Any], kind: str) -> Any:
    """The content of a json file that has the form of a json schema.

    Args:
        path: Path of the file.
        schema: Json schema that the content must fulfil.
        kind: What the file should be, with its article, for the error message: "a manifest".

    Raises:
        InvalidFileError: The file cannot be read, is not json, or has another form.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        jsonschema.validate(content, schema)
    except jsonschema.ValidationError as error:
        raise InvalidFileError(_not(path, kind, f"{error.json_path}: {error.message[:SHOWN_LENGTH]}")) from error
    except (OSError, ValueError, RecursionError) as error:
        raise InvalidFileError(_not(path, kind, str(error))) from error
    return content


def move(source: Path, target: Path) -> None:
    """Rename a file or a folder, and let the new name reach the disk.

    Raises:
        FileWriteError: It cannot be renamed.
    """
    try:
        source.replace(target)
        _flush(target.parent)
    except OSError as error:
        raise FileWriteError(
            f"{source} cannot be moved to {target} ({error}); get the permission, or give another path"
        ) from error


def remove_folder(folder: Path) -> None:
    """Remove a folder, which need not exist, in one step: it is renamed to a hidden name first, and then deleted.

    Where a deletion is interrupted, the next call for the same path completes it, and so does `remove_leftovers`.

    Raises:
        FileWriteError: The folder cannot be renamed.
    """
    if folder.exists():
        move(folder, folder.with_name(f".{folder.name}.{uuid4().hex}{PARTIAL}"))
    _delete_all(folder.parent, f".{folder.name}.*{PARTIAL}")


def remove_leftovers(folder: Path) -> None:
    """Delete the folders inside a folder that processes were writing or deleting when they were killed."""
    _delete_all(folder, f".*{PARTIAL}")


def _delete_all(folder: Path, pattern: str) -> None:
    for path in folder.glob(pattern):
        shutil.rmtree(path, ignore_errors=True)  # what cannot be deleted now is deleted by a later call


def _not(path: Path, kind: str, reason: str) -> str:
    return f"{path} is not {kind} ({reason}); copy it or make it again"


def _flush(path: Path) -> None:
    """Let a file, or the entries of a folder, reach the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
