"""Gentle success: the task is solved, and the contact force of the held object stayed within a limit until then.

The limit of each task is `TaskSpec.force_limit`, twice the median over demonstrations of their largest contact force.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np


def is_gentle(episode: dict[str, Any], force: float) -> bool:
    """Whether an episode succeeded, and its contact force stayed within a limit up to the first success.

    Args:
        episode: Episode of a result file.
        force: Largest force allowed, in N.
    """
    needed = episode["force_until_success"]  # None without success
    return needed is not None and needed <= force


def success_under_force(episodes: Iterable[dict[str, Any]], forces: Sequence[float] | np.ndarray) -> np.ndarray:
    """The curve of success against the force allowed: the share of episodes (forces,) that succeed gently under each limit.

    Args:
        episodes: Episodes of one or several result files.
        forces: Limits, in N.
    """
    needed = np.array([episode["force_until_success"] for episode in episodes], float)  # NaN without success
    return (needed <= np.asarray(forces)[:, None]).mean(1)
