"""Locks, so that only one process at a time works on a file or folder.

The lock is advisory and belongs to the operating system (`filelock`): it ends with the process that holds it, however that
process ends. A small json beside it names the holder, for the message that the second process gets.
"""

import json
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path

from filelock import FileLock, Timeout

from .errors import InUseError, MachineError
from .processes import process_exists

PATIENCE = 0.5
"""Time, in s, for which a process tries to hold a path: another may hold it for a moment, in `is_owned`."""
MAX_COMMAND = 80
"""Largest number of characters of a command in a message; those of Ray's workers have 900."""


@contextmanager
def owned(path: Path) -> Iterator[None]:
    """Hold a file or folder, which need not exist yet, for as long as the context lasts.

    Args:
        path: File or folder. Its parent folder is created if it is missing and receives the lock, `.<name>.lock`.

    Raises:
        InUseError: Another process holds it; the message names the process.
        MachineError: The parent folder cannot be created or written.
    """
    path = Path(path).absolute()
    holder = _beside(path, "holder.json")
    try:
        held = _lock(path, PATIENCE)
    except Timeout:
        raise InUseError(f"{path} is in use by {_described(holder)}; wait until it ends, or give another path") from None
    try:
        with suppress(OSError):  # the lock works without the name: the disk may be full, or the file another user's
            _write_holder(holder)
        yield
    finally:
        with suppress(OSError):
            holder.unlink(missing_ok=True)
        held.release()


def is_owned(path: Path) -> bool:
    """Whether another process, or another part of this one, holds a file or folder in whose parent folder one can write.

    Raises:
        MachineError: The parent folder cannot be created or written.
    """
    try:
        _lock(Path(path).absolute(), patience=0.0).release()
    except Timeout:
        return True
    return False


def _lock(path: Path, patience: float) -> FileLock:
    """Take the lock of a path, or raise `Timeout` if others hold it for longer than `patience`, in s."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(_beside(path, "lock"), patience, mode=0o666)  # another user of the machine may be the next to hold it
        lock.acquire()
    except Timeout:
        raise
    except OSError as error:
        raise MachineError(f"{path.parent} cannot be written ({error.strerror}); give another path") from error
    return lock


def _beside(path: Path, kind: str) -> Path:
    return path.with_name(f".{path.name}.{kind}")


def _write_holder(path: Path) -> None:
    started = datetime.now(timezone.utc).isoformat(timespec="seconds")
    content = dict(pid=os.getpid(), host=socket.gethostname(), command=" ".join(sys.argv), since=started)
    path.write_text(json.dumps(content), encoding="utf-8")


def _described(path: Path) -> str:
    try:
        holder = json.loads(path.read_text(encoding="utf-8"))
        if holder["host"] != socket.gethostname() or process_exists(holder["pid"]):
            return f"process {holder['pid']} on {holder['host']} since {holder['since']} ({holder['command'][:MAX_COMMAND]})"
    except (OSError, ValueError, KeyError, TypeError):  # the other process has just begun, or has just ended
        pass
    return "another process"
