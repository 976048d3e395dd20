"""Demonstrator of ObjectSearch: grasp in one place, feel whether something is between the fingers, else try the other."""

import numpy as np

from manifeel_ms3.geometry.containers import BATTERY_SIZE, CONTAINER_FLOOR
from manifeel_ms3.tasks.exploration.object_search import CONTAINER_XY, PLACES_X, ObjectSearchEnv
from manifeel_ms3.tasks.registry import register_demonstrator

from .skills import DOWNWARD, Actions, Skills

OVER = 0.21  # m: tool height over the container, the fingertips clear of the battery
GRASP = CONTAINER_FLOOR + BATTERY_SIZE / 2 + 0.010  # m: the pads' lower half closes on the cube
FELT = 3.0  # N on each pad: something is between the fingers
LIFT_BY = 0.13  # m


@register_demonstrator("ManiFeel-ObjectSearch-v1")
class ObjectSearchExpert:
    """Knows the two places, guesses one, and goes by what the pads feel when it closes the fingers there."""

    def __init__(self, env: ObjectSearchEnv, seed: int):
        rng = np.random.default_rng([seed, 11])
        self.skills = Skills(env)
        self.skills.gripper = 1.0
        self.guess = int(rng.integers(2))

    def actions(self) -> Actions:
        skills = self.skills
        for place in (self.guess, 1 - self.guess, self.guess, 1 - self.guess):
            above = np.array([CONTAINER_XY[0] + PLACES_X[place], CONTAINER_XY[1], OVER])
            yield from skills.reach(above, DOWNWARD, tolerance=2e-3)
            yield from skills.reach(np.array([*above[:2], GRASP]), DOWNWARD, tolerance=1.5e-3)
            yield from skills.set_gripper(-1.0)
            if skills.squeeze.min() > FELT:
                break
            yield from skills.set_gripper(1.0, steps=4)
            yield from skills.reach(above, DOWNWARD, tolerance=5e-3)
        yield from skills.lift_and_hold(LIFT_BY, DOWNWARD)
