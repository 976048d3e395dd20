"""The shipped sample of demonstrations."""

from pathlib import Path

from manifeel_ms3.demonstrations.recording import STATES_FILE, observed_file
from manifeel_ms3.paths import data_dir


def states_sample(task: str) -> Path:
    """File of states and actions alone."""
    return data_dir() / "sample" / task / STATES_FILE


def observed_sample(task: str) -> Path:
    """File with observations."""
    path = observed_file(data_dir() / "sample" / task)
    assert path
    return path
