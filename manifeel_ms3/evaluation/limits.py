"""Time and force limits of tasks, from demonstrations: `python -m manifeel_ms3.evaluation.limits data/demos/*/trajectory.h5`.

The registration of each task (`max_episode_steps`, `force_limit`, `demo_steps`) holds such numbers. Most limits were computed
from earlier demonstrators and are kept, so that results stay comparable (docs/evaluation.md).
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from manifeel_ms3.command_line import run
from manifeel_ms3.demonstrations.formats.maniskill_h5 import read_header
from manifeel_ms3.errors import InvalidFileError

MEAN_FACTOR, LONGEST_FACTOR = 2.0, 1.5
"""Smallest ratios of the time limit to the mean length of demonstrations, as ManiSkill's baselines recommend, and to the
longest demonstration, which is our choice."""
FORCE_FACTOR = 2.0
"""Ratio of the force limit to the median of the demonstrations' largest contact forces: our choice."""
STEPS = 10
"""Time limits are multiples of this number of control steps."""


@dataclass(frozen=True)
class Limits:
    """Limits of a task, and the demonstrations that they follow from."""

    max_episode_steps: int
    """Time limit, in control steps."""
    force_limit: float
    """Largest contact force of a gentle success, in N."""
    demo_steps: float
    """Mean number of control steps of a demonstration."""
    longest: int
    """Largest number of control steps of a demonstration."""


def limits_of(lengths: list[int], peak_forces: list[float]) -> Limits:
    """The limits that follow from demonstrations.

    Args:
        lengths: Numbers of control steps.
        peak_forces: Largest contact forces, in N.
    """
    steps = max(MEAN_FACTOR * float(np.mean(lengths)), LONGEST_FACTOR * max(lengths))
    force = FORCE_FACTOR * float(np.median(peak_forces))
    return Limits(STEPS * math.ceil(steps / STEPS), float(math.ceil(force)), round(float(np.mean(lengths)), 1), max(lengths))


def limits_of_file(path: Path) -> Limits:
    """The limits that follow from the successful demonstrations of a trajectory file.

    Raises:
        InvalidFileError: The file holds no successful demonstration, or does not name their forces.
    """
    episodes = [episode for episode in read_header(path)["episodes"] if episode["success"]]
    forces = [episode["peak_contact_force"] for episode in episodes if "peak_contact_force" in episode]
    if not episodes or len(forces) < len(episodes):
        raise InvalidFileError(f"{path} holds no successful demonstrations with forces; give a file of `manifeel record`")
    return limits_of([episode["elapsed_steps"] for episode in episodes], forces)


@dataclass
class Args:
    """Arguments of the command."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    """Trajectory files, one for each task; their json files hold all that is needed."""


def main(args: Args) -> None:
    """Print the limits of each file.

    Raises:
        InvalidFileError: A file is missing, or holds no demonstrations.
    """
    for path in args.files:
        sys.stdout.write(f"{path.parent.name}: {limits_of_file(path)}\n")


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
