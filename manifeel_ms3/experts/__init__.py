"""Scripted demonstrators. Importing this package attaches them to their tasks (`manifeel_ms3.tasks.registry`)."""

from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np

from manifeel_ms3.errors import UnknownNameError
from manifeel_ms3.tasks import VisuotactileEnv
from manifeel_ms3.tasks.registry import all_tasks, task_spec

from .ball_sorting import BallSortingExpert as BallSortingExpert
from .leaning_insertion import LeaningInsertionExpert as LeaningInsertionExpert
from .object_search import ObjectSearchExpert as ObjectSearchExpert
from .peg_reorientation import PegReorientationExpert as PegReorientationExpert
from .screwing import BulbExpert as BulbExpert
from .screwing import ScrewingExpert as ScrewingExpert
from .upright_insertion import UprightInsertionExpert as UprightInsertionExpert


class Expert(Protocol):
    """Demonstrator of one episode, which is made after `env.reset(seed=seed)`."""

    def actions(self) -> Iterator[np.ndarray]:
        """Actions in [-1, 1], one for every step; take each one in the environment before asking for the next."""
        ...


def make_expert(env_id: str, env: VisuotactileEnv, seed: int) -> Expert:
    """Make the demonstrator of a task for the episode that the environment has just been reset to.

    Args:
        env_id: Id of the task.
        env: The environment, without its wrappers.
        seed: Seed of the episode; the demonstrator draws its errors of perception and its guesses from it.

    Raises:
        UnknownNameError: The task is not registered, or has no demonstrator.
    """
    return require_demonstrator(env_id)(env, seed)


def require_demonstrator(env_id: str) -> Callable[[Any, int], Expert]:
    """Callable that makes a task's demonstrator from an environment and a seed.

    Raises:
        UnknownNameError: The task is not registered, or has no demonstrator.
    """
    demonstrator = task_spec(env_id).demonstrator
    if demonstrator is None:
        known = [name for name, spec in all_tasks().items() if spec.demonstrator is not None]
        raise UnknownNameError(f"{env_id!r} has no demonstrator; tasks with one are {known}")
    return demonstrator
