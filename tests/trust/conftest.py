"""Fixtures of the tests of trust: a submission, a trajectory file and a secret that nothing may read."""

import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.leaderboard.made_up import made_up

from .files_of_strangers import SAMPLE, SECRET

MAX_MEMORY = 300e6
"""Bytes by which the process may grow at its peak while it reads a damaged file; the files have less than a megabyte."""


@pytest.fixture
def folder(tmp_path) -> Path:
    return made_up(tmp_path / "theirs", "Theirs", "PegInsertion", "rgb", 10)


@pytest.fixture
def demo(tmp_path) -> Path:
    """A copy of the sample's trajectory file, for tests to damage."""
    for suffix in (".h5", ".json"):
        shutil.copy(SAMPLE.with_suffix(suffix), tmp_path / f"trajectory{suffix}")
    return tmp_path / "trajectory.h5"


@pytest.fixture
def secret(tmp_path) -> Path:
    path = tmp_path / "elsewhere/secret.txt"
    path.parent.mkdir()
    path.write_bytes(SECRET)
    return path


@pytest.fixture
def bounded_memory(figure):
    """A context that compares the growth of this process's resident memory at its peak with `MAX_MEMORY`."""

    def peak_memory() -> int:
        with Path("/proc/self/status").open() as file:
            return 1024 * next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))

    @contextmanager
    def measured(what: str):
        Path("/proc/self/clear_refs").write_text("5")  # the peak of memory is measured from here
        start = peak_memory()
        yield
        figure(f"peak of memory over {what}, MB", (peak_memory() - start) / 1e6, at_most=MAX_MEMORY / 1e6)

    return measured
