"""Failure floors: how often a task succeeds without any skill, so that a success rate can be read against it.

Each task has one file in the folder data/floors, which `python -m baselines.floors` measures and writes. It holds the success
of three policies that have learnt nothing (`POLICIES`), with Wilson intervals. A floor counts only for the revision of the
task, and for the default arguments, that it was measured with.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manifeel_ms3.files import read_json
from manifeel_ms3.paths import data_dir

FLOORS_SCHEMA = "manifeel-floors-1"
"""Name and version of the form of the files."""
POLICIES = {
    "random": "uniformly random actions",
    "mean action": "the mean action of demonstrations",
    "untrained": "the network of the preset `cpu` before training",
}
"""The policies by the names of their floors."""
_SHARE = {"type": "number", "minimum": 0, "maximum": 1}
FORM = {
    "type": "object",
    "required": ["schema", "env_id", "revision", "git_commit", "command", "floors"],
    "properties": {
        "schema": {"const": FLOORS_SCHEMA},
        "env_id": {"type": "string"},
        "revision": {"type": "integer", "minimum": 1},
        "git_commit": {"type": ["string", "null"]},
        "command": {"type": "string"},
        "floors": {
            "type": "object",
            "minProperties": 1,
            "propertyNames": {"enum": list(POLICIES)},
            "additionalProperties": {
                "type": "object",
                "required": ["episodes", "rate", "low", "high"],
                "properties": {"episodes": {"type": "integer", "minimum": 1}, "rate": _SHARE, "low": _SHARE, "high": _SHARE},
                "additionalProperties": False,
            },
        },
    },
    "additionalProperties": False,
}
"""Json schema of a file."""


@dataclass(frozen=True)
class Floor:
    """Success of one policy that has learnt nothing."""

    policy: str
    """Name of the policy, one of POLICIES."""
    episodes: int
    """Number of episodes that were run."""
    rate: float
    """Share of them that succeeded."""
    low: float
    """Lower end of the Wilson interval of 95 %."""
    high: float
    """Upper end of the interval."""

    def __str__(self) -> str:
        return f"{self.rate:.0%} [{self.low:.0%}, {self.high:.0%}]"


def floors_of(env_id: str, revision: int, variant: str = "", folder: Path | None = None) -> dict[str, Floor]:
    """The floors of a task by the names of the policies; {} where none were measured.

    Args:
        env_id: Id of the task.
        revision: Revision of the task.
        variant: Arguments of the task other than its defaults, for which no floor is known; "" for the defaults.
        folder: Folder of the files; that of the package if not given.

    Raises:
        InvalidFileError: The file of the task is broken.
    """
    path = floors_file(env_id, folder)
    if variant or not path.is_file():
        return {}
    content: dict[str, Any] = read_json(path, FORM, "the failure floors of a task")
    if content["revision"] != revision:
        return {}
    return {name: Floor(name, **numbers) for name, numbers in content["floors"].items()}


def highest_floor(env_id: str, revision: int, variant: str = "", folder: Path | None = None) -> Floor | None:
    """The floor that a policy must exceed: the highest of the task, by rate and then by the end of its interval.

    Args:
        env_id: Id of the task.
        revision: Revision of the task.
        variant: Arguments of the task other than its defaults, for which no floor is known; "" for the defaults.
        folder: Folder of the files; that of the package if not given.

    Raises:
        InvalidFileError: The file of the task is broken.
    """
    floors = floors_of(env_id, revision, variant, folder).values()
    return max(floors, key=lambda floor: (floor.rate, floor.high), default=None)


def floors_file(env_id: str, folder: Path | None = None) -> Path:
    """The file of a task's floors."""
    return (folder or data_dir() / "floors") / f"{env_id}.json"
