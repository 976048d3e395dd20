"""Scripted demonstrators, one a task."""

from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np

from manifeel_ms3.tasks import VisuotactileEnv

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


EXPERTS: dict[str, Callable[[Any, int], Expert]] = {
    "ManiFeel-PegInsertion-v1": InsertionExpert,
    "ManiFeel-PegReorientation-v1": InsertionExpert,
    "ManiFeel-USBInsertion-v1": InsertionExpert,
    "ManiFeel-BallSorting-v1": BallSortingExpert,
    "ManiFeel-BallSortingDim-v1": BallSortingExpert,
    "ManiFeel-GearAssembly-v1": GearExpert,
    "ManiFeel-BulbInstallation-v1": ScrewingExpert,
    "ManiFeel-NutBoltAssembly-v1": ScrewingExpert,
    "ManiFeel-ObjectSearch-v1": ObjectSearchExpert,
    "ManiFeel-PowerPlugInsertion-v1": InsertionExpert,
}


def make_expert(env_id: str, env: VisuotactileEnv, seed: int) -> Expert:
    """The demonstrator of a task.

    Raises:
        ValueError: the task has none.
    """
    if env_id not in EXPERTS:
        raise ValueError(f"{env_id!r} has no demonstrator; there are ones for {sorted(EXPERTS)}")
    return EXPERTS[env_id](env, seed)
