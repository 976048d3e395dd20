"""Reading and writing of files: a file appears as a whole or not at all, even if the program is killed while it writes."""

import hashlib
import json
import os
import re
import shutil
import socket
import time
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import Any
from uuid import uuid4

import jsonschema
import numpy as np

from .errors import InvalidFileError, ManifeelError
from .processes import process_exists

PARTIAL = ".partial"
"""End of the name of a file or folder while it is written or deleted."""
SHOWN_LENGTH = 200
"""Number of characters that a message shows of an error of jsonschema, which quotes the whole content; set once, not tuned."""
MOST_UNPACKED = 2**29
"""Number of bytes up to which an npz file may unpack; set once, not tuned. Taxim's largest file unpacks to a third of it."""
NOT_NPZ = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, MemoryError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error),
)
"""What numpy raises for a file that is no npz file, is damaged, or holds objects, which it would have to unpickle."""
ABANDONED_AFTER = 24 * 3600
"""Time in s after which what another machine has not finished writing counts as left by a process that was killed; set once,
not tuned."""
HASH_BLOCK = 2**20
"""Number of bytes that are read at a time for a hash; set once, not tuned."""


class FileWriteError(ManifeelError, OSError):
    """A file cannot be written: its folder is read-only or is a file, the disk is full, or a permission is missing."""


@contextmanager
def failures_named(path: Path, inside: Path | None = None) -> Iterator[None]:
    """Turn a failure of the file system into an error that names the path that was to be written.

    An error that already says what to do, which is a `ManifeelError`, stays as it is.

    Args:
        path: Path that was to be written.
        inside: Path to which the context writes, if it also does other work, such as reading files. Errors that name another
            path then stay as they are.

    Raises:
        FileWriteError: The context raised an `OSError`.
    """
    try:
        yield
    except ManifeelError:
        raise
    except OSError as error:
        if inside and not _may_be_about(error, inside):
            raise
        raise FileWriteError(
            f"{path} cannot be written ({error}); make room or get the permission, or give another path"
        ) from error


def _may_be_about(error: OSError, path: Path) -> bool:
    """Whether an error names a path or something in it, or names no path, as that of a full disk does."""
    named = error.filename
    if not isinstance(named, str | bytes | os.PathLike):
        return True
    return Path(os.fsdecode(named)).absolute().is_relative_to(path.absolute())


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
    partial = _temporary(path)
    try:
        with failures_named(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            _delete_abandoned(path)
        with failures_named(path, inside=partial):
            yield partial
        with failures_named(path):
            flush(partial)
            partial.replace(path)
            flush(path.parent)
    finally:
        _delete(partial)


@contextmanager
def atomic_folder(path: Path, replace: bool = False) -> Iterator[Path]:
    """Make a folder that appears as a whole once the context has filled the temporary folder that it is given.

    Args:
        path: Path of the folder. Its parent folder is made where it does not exist.
        replace: Let the new folder take the place of an old one, which is deleted afterwards. Without it, the folder must not
            exist, or be empty. `restore_folder` completes what a process that was killed in between has left.

    Raises:
        FileWriteError: The folder cannot be written; the message has the path and the reason.
    """
    path = Path(path)
    partial, old = _temporary(path), _replaced(path)
    if replace:
        restore_folder(path)
    try:
        with failures_named(path):
            partial.mkdir(parents=True)
            _delete_abandoned(path)
        with failures_named(path, inside=partial):
            yield partial
        with failures_named(path):
            for entry in (*partial.rglob("*"), partial):
                flush(entry)
            if replace and path.exists():
                path.rename(old)
            try:
                partial.rename(path)
            except OSError:
                restore_folder(path)
                raise
            flush(path.parent)
            _delete(old)
    finally:
        _delete(partial)


def restore_folder(path: Path) -> None:
    """Put a folder back that a killed process was replacing; delete the old one where the new one is in its place already.

    Raises:
        FileWriteError: The folder cannot be renamed.
    """
    old = _replaced(path)
    if path.exists():
        _delete(old)
    elif old.exists():
        move(old, path)


def _replaced(path: Path) -> Path:
    """Path of a folder from the moment when it makes room for a new one until that is in its place."""
    return path.with_name(f".{path.name}.replaced")


def _temporary(path: Path) -> Path:
    """Path of a file or folder while it is written or deleted, which no other process on any machine uses."""
    return path.with_name(f".{path.name}.{_this_machine()}-{os.getpid()}-{uuid4().hex[:8]}{PARTIAL}")


def _this_machine() -> str:
    """Name of this machine in the names of its temporary files."""
    return re.sub(r"\W", "_", socket.gethostname())


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
        kind: What the file should be, with its article, for the error message, such as "a manifest".

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


def read_npz(path: Path, kind: str, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """Arrays of an npz file by their names; nothing in the file is unpickled.

    Args:
        path: Path of the file.
        kind: What the file should be, with its article, for the error message, such as "a shader file".
        names: Names of the arrays to read; all if None.

    Raises:
        InvalidFileError: The file cannot be read, is no npz file, lacks an array, or unpacks to more than `MOST_UNPACKED`.
    """
    with _opened_npz(path, kind) as stored:
        return {name: stored[name] for name in (stored.files if names is None else names)}


def names_in_npz(path: Path, kind: str) -> list[str]:
    """Names of the arrays of an npz file, none of which is read.

    Args:
        path: Path of the file.
        kind: As for `read_npz`.

    Raises:
        InvalidFileError: The file cannot be read, is no npz file, or unpacks to more than `MOST_UNPACKED`.
    """
    with _opened_npz(path, kind) as stored:
        return stored.files


@contextmanager
def _opened_npz(path: Path, kind: str) -> Iterator[Any]:
    """A file as numpy opens it; whatever is wrong with it is an error that names it."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MOST_UNPACKED:
            raise ValueError(f"it unpacks to {size:,} bytes, more than {MOST_UNPACKED:,}")
        with np.load(path) as stored:
            yield stored
    except NOT_NPZ as error:
        raise InvalidFileError(_not(path, kind, str(error))) from error


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """The objects in a file that holds one json object per line, such as a log.

    Lines that hold no json object are skipped, such as an incomplete line that a killed process left.

    Args:
        path: Path of the file, which need not exist.

    Raises:
        InvalidFileError: The file cannot be read.
    """
    found = []
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else []
    except OSError as error:
        raise InvalidFileError(_not(path, "a log", str(error))) from error
    for line in lines:
        with suppress(ValueError, RecursionError):
            if isinstance(entry := json.loads(line), dict):
                found.append(entry)
    return found


def file_hash(*paths: Path) -> str:
    """SHA-256 of the contents of files, one after the other, in hexadecimal digits.

    Args:
        paths: Paths of the files.

    Raises:
        OSError: A file cannot be read.
    """
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            while block := file.read(HASH_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def visible_files(folder: Path, pattern: str) -> list[Path]:
    """The files of a folder and its folders that match a pattern, except for those in hidden folders.

    A process that is killed while it writes leaves a hidden folder.
    """
    found = sorted(folder.rglob(pattern))
    return [path for path in found if not any(part.startswith(".") for part in path.relative_to(folder).parts)]


def move(source: Path, target: Path) -> None:
    """Rename a file or a folder, and write the new name to the disk.

    Raises:
        FileWriteError: The file or folder cannot be renamed.
    """
    try:
        source.replace(target)
        flush(target.parent)
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
        move(folder, _temporary(folder))
    _delete_all(folder.parent, f".{escape(folder.name)}.*{PARTIAL}")


def remove_leftovers(folder: Path) -> None:
    """Delete what processes were writing into a folder, or deleting from it, when they were killed."""
    for path in folder.glob(f".*{PARTIAL}"):
        _delete_if_abandoned(path)


def _delete_all(folder: Path, pattern: str) -> None:
    for path in folder.glob(pattern):
        _delete(path)


def _delete(path: Path) -> None:
    """Delete a file, a link or a folder, which need not exist; what cannot be deleted now is deleted by a later call."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _delete_abandoned(path: Path) -> None:
    """Delete what earlier writers of a file or folder left when they were killed."""
    for old in path.parent.glob(f".{escape(path.name)}.*{PARTIAL}"):
        _delete_if_abandoned(old)


def _delete_if_abandoned(partial: Path) -> None:
    """Delete a temporary file or folder whose writer has ended."""
    writer = re.fullmatch(r"\..+\.(\w+)-(\d+)-\w+", partial.name.removesuffix(PARTIAL))
    with suppress(FileNotFoundError):  # its writer ends at this moment
        if writer and _was_abandoned(partial, writer[1], int(writer[2])):
            _delete(partial)


def _was_abandoned(partial: Path, machine: str, process: int) -> bool:
    """Whether the process that wrote a temporary file or folder has ended, which shows only slowly on another machine."""
    if machine == _this_machine():
        return not process_exists(process)
    written = max(path.lstat().st_mtime for path in (partial, *partial.rglob("*")))
    return time.time() - written > ABANDONED_AFTER


def _not(path: Path, kind: str, reason: str) -> str:
    return f"{path} is not {kind} ({reason}); copy it or make it again"


def flush(path: Path) -> None:
    """Write a file, or the entries of a folder, from the system's cache to the disk (fsync).

    Raises:
        OSError: The path cannot be opened or written.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
