"""Scripted demonstrators. Importing this package attaches them to their tasks (`manifeel_ms3.tasks.registry`)."""

from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np

from manifeel_ms3.errors import UnknownNameError
from manifeel_ms3.tasks import VisuotactileEnv
from manifeel_ms3.tasks.registry import all_tasks, task_spec

from .ball_sorting import BallSortingExpert as BallSortingExpert
from .insertion import GearExpert as GearExpert
from .insertion import InsertionExpert as InsertionExpert
from .object_search import ObjectSearchExpert as ObjectSearchExpert
from .screwing import ScrewingExpert as ScrewingExpert


class Expert(Protocol):
    """A demonstrator for one episode, made after `env.reset(seed=seed)`."""

    def actions(self) -> Iterator[np.ndarray]:
        """Actions in [-1, 1], one for every step; the iterator is advanced after the step before has been taken."""
        ...


def make_expert(env_id: str, env: VisuotactileEnv, seed: int) -> Expert:
    """The demonstrator of a task, for the episode that the environment has just been reset to.

    Raises:
        UnknownNameError: The task is not registered, or has no demonstrator.
    """
    return require_demonstrator(env_id)(env, seed)


def require_demonstrator(env_id: str) -> Callable[[Any, int], Expert]:
    """What makes the demonstrator of a task from an environment and a seed.

    Raises:
        UnknownNameError: The task is not registered, or has no demonstrator.
    """
    demonstrator = task_spec(env_id).demonstrator
    if demonstrator is None:
        known = [name for name, spec in all_tasks().items() if spec.demonstrator is not None]
        raise UnknownNameError(f"{env_id!r} has no demonstrator; tasks with one are {known}")
    return demonstrator
