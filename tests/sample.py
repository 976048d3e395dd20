"""The sample of demonstrations that ships with the package."""

from pathlib import Path

from manifeel_ms3.demonstrations.recording import STATES_FILE, observed_file
from manifeel_ms3.paths import data_dir

KEYS = ["sensor_data/wrist/rgb", "sensor_data/tactile_right/force_field", "extra/tcp_pose"]
"""Observations of the peg's sample, and of the LeRobot datasets among the tests."""


def states_sample(task: str) -> Path:
    """The task's file of states and actions alone."""
    return data_dir() / "sample" / task / STATES_FILE


def observed_sample(task: str) -> Path:
    """The task's file with observations."""
    path = observed_file(data_dir() / "sample" / task)
    assert path
    return path
