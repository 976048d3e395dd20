"""Evaluations that are under way in other processes."""

import os
import time
from contextlib import suppress
from pathlib import Path

import psutil

PATIENCE = 120  # s


def wait_for_episodes(journal: Path, number: int) -> None:
    deadline = time.monotonic() + PATIENCE
    while not journal.is_file() or len(journal.read_text().splitlines()) < 1 + number:
        assert time.monotonic() < deadline, "no episode was finished"
        time.sleep(0.1)


def alive(group: int) -> list[int]:
    """The processes of a group that have not ended."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.NoSuchProcess, ProcessLookupError):
            if os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
    return found
