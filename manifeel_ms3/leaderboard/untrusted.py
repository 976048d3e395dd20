"""Reading of a folder that a stranger has made.

Only regular files are read, never through a symbolic link, each up to a limit, and every file once: what is checked is what is
copied and shown later. Json is read strictly: numbers are finite, integers have 64 bits, text is Unicode, nesting is shallow.
"""

import json
import math
import os
import stat
from pathlib import Path
from typing import Any, NoReturn

from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.files import SHOWN_LENGTH
from manifeel_ms3.paths import CHECKPOINTS

LARGEST = {".json": 2**20, ".mp4": 16 * 2**20}
"""Largest size of a file in bytes, by the endings that are read; a result of 50 episodes has 13 kB."""
LARGEST_TOTAL = 128 * 2**20
"""Largest size of all files that are read, in bytes."""
MOST_ENTRIES = 4000
"""Largest number of files and folders; the paper's protocol needs 30 results for each row of the page."""
DEEPEST_FOLDER = 8
"""Largest number of folders inside each other; the results in this repository have 3."""
DEEPEST_JSON = 32
"""Largest number of lists and objects inside each other; a result has 5."""
LARGEST_INTEGER = 2**63 - 1
"""Largest integer of 64 bits with a sign."""


class UntrustedFileError(InvalidFileError):
    """A file of a stranger is not of the kind, size or form that is read."""


class FolderReader:
    """Reads the json files and videos of a folder, and collects what is wrong with its other entries.

    Args:
        folder: The folder.
    """

    def __init__(self, folder: Path):
        self.contents: dict[Path, bytes] = {}
        self.faults: list[str] = []
        self._entries = self._total = 0
        if folder.is_symlink() or not folder.is_dir():
            self.faults.append("it is not a folder, or a symbolic link to one; give the folder itself")
            return
        try:
            for place, folders, files, descriptor in os.fwalk(folder, onerror=_reraise):
                # checkpoints are not read; maintainers keep those of an entry beside its results
                folders[:] = [name for name in folders if name != CHECKPOINTS]
                self._read_level(Path(place).relative_to(folder), folders, files, descriptor)
        except UntrustedFileError as error:
            self.faults.append(str(error))
        except OSError as error:
            self.faults.append(f"it cannot be read ({error}); get the permission, or copy it again")

    def _read_level(self, place: Path, folders: list[str], files: list[str], descriptor: int) -> None:
        if len(place.parts) > DEEPEST_FOLDER:
            raise UntrustedFileError(f"its folders are nested deeper than {DEEPEST_FOLDER}; put the results further up")
        for name in sorted(folders + files):
            path = place / name
            self._entries += 1
            if self._entries > MOST_ENTRIES:
                raise UntrustedFileError(f"it holds more than {MOST_ENTRIES} files; split it into several submissions")
            mode = os.stat(name, dir_fd=descriptor, follow_symlinks=False).st_mode
            if not (stat.S_ISDIR(mode) or stat.S_ISREG(mode)):
                self.faults.append(f"{quoted(path)} is a symbolic link or a special file; put the file itself there")
            elif stat.S_ISREG(mode) and path.suffix in LARGEST:
                self._read_file(path, descriptor)

    def _read_file(self, path: Path, descriptor: int) -> None:
        limit = LARGEST[path.suffix]
        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK  # the entry may have been exchanged since it was looked at
        with os.fdopen(os.open(path.name, flags, dir_fd=descriptor), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise UntrustedFileError(f"{quoted(path)} changes while it is read; copy the submission first")
            content = file.read(limit + 1)
        if len(content) > limit:
            self.faults.append(f"{quoted(path)} has more than {limit // 2**20} MiB; make it smaller")
            return
        self._total += len(content)
        if self._total > LARGEST_TOTAL:
            raise UntrustedFileError(f"its files have more than {LARGEST_TOTAL // 2**20} MiB; leave some videos out")
        self.contents[path] = content


def parse_json(content: bytes, path: Path) -> Any:
    """The content of a json file, read strictly.

    Args:
        content: Bytes of the file.
        path: Path of the file, for messages.

    Raises:
        UntrustedFileError: It is not json in UTF-8, or has a number, a text or a depth that is not allowed.
    """
    try:
        value = json.loads(content.decode("utf-8"), parse_constant=_refuse_constant)
    except RecursionError:
        raise UntrustedFileError(f"{quoted(path)} is nested too deeply; a result never is") from None
    except ValueError as error:  # includes errors of Unicode, of json, and of integers with thousands of digits
        reason = str(error)[:SHOWN_LENGTH]
        raise UntrustedFileError(f"{quoted(path)} cannot be read as json ({reason}); evaluate the policy again") from None
    if fault := _fault_of(value):
        raise UntrustedFileError(f"{quoted(path)} {fault}; evaluate the policy again")
    return value


def quoted(path: Path) -> str:
    """The path as a message may show it: a name with line breaks or control characters appears in quotes, with escapes."""
    text = str(path)
    return text if text.isprintable() else ascii(text)


def _fault_of(value: Any) -> str | None:
    waiting = [(value, 0)]
    while waiting:
        item, depth = waiting.pop()
        if depth > DEEPEST_JSON:
            return f"is nested deeper than {DEEPEST_JSON}"
        if isinstance(item, dict):
            waiting += [(part, depth + 1) for entry in item.items() for part in entry]
        elif isinstance(item, list):
            waiting += [(part, depth + 1) for part in item]
        elif isinstance(item, float) and not math.isfinite(item):
            return "has a number that is too large for a float"
        elif isinstance(item, int) and abs(item) > LARGEST_INTEGER:
            return "has an integer of more than 64 bits"
        elif isinstance(item, str) and any("\ud800" <= letter <= "\udfff" for letter in item):
            return "has a text that is not Unicode"
    return None


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number of json")


def _reraise(error: OSError) -> NoReturn:
    raise error
