"""Fixtures of the tests of trust: a submission, a trajectory file and a secret that nothing may read."""

import shutil
from pathlib import Path

import pytest

from tests.leaderboard.made_up import made_up

from .files_of_strangers import SAMPLE, SECRET


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
