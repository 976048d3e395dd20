"""Demonstrator of ObjectSearch: grasp in one place; if nothing is felt between the fingers, grasp in the other."""

from dataclasses import dataclass

import numpy as np

from manifeel_ms3.geometry.containers import BATTERY_SIZE, CONTAINER_FLOOR
from manifeel_ms3.tasks.exploration.object_search import CONTAINER_XY, PLACES_X, ObjectSearchEnv
from manifeel_ms3.tasks.registry import register_demonstrator

from .skills import DOWNWARD, Actions, Skills


@dataclass(frozen=True)
class ObjectSearchExpertConfig:
    """Constants of the demonstrator of ObjectSearch.

    Values without another origin were tuned by hand; docs/tasks.md has the success over seeds 0 to 99.
    """

    hover_height: float = 0.07
    """Height of the tool over the table between grasps, in m, as at the start: the fingertips are clear of the battery."""
    grasp_above_centre: float = 0.010
    """Height of the tool over the cube's centre at the grasp, in m: the pads' lower half closes on the cube."""
    felt_force: float = 3.0
    """Normal force on each pad, in N, above which something is between the fingers. Tuned."""
    lift_height: float = 0.13
    """Distance by which the battery is lifted, in m: the goal of 0.10 m with a margin."""
    free_tolerance: float = 2e-3
    """Distance from the point over a place at which the hand has arrived before a grasp, in m. Tuned."""
    grasp_tolerance: float = 1.5e-3
    """Distance from the grasp position at which the fingers close, in m. Tuned."""
    crossing_height: float = 0.11
    """Height of the tool over the table on the way from one place to the other, in m. It differs from every
    height on the way to the first place, so that a policy without memory can tell the two ways apart."""
    crossing_tolerance: float = 0.01
    """Distance from the middle of the way between the places at which the hand goes on, in m. Tuned."""
    grip_steps: int = 6
    """Largest number of steps for which the fingers close. Tuned."""


@register_demonstrator("ManiFeel-ObjectSearch-v1")
class ObjectSearchExpert:
    """Knows the two places, searches the one nearer to the robot first, and decides by the force on the pads.

    Where its fingers close on nothing, it goes to the other place by a higher way than it came. Otherwise it would be back at
    its start in the middle, and a policy without memory would begin anew.
    """

    config = ObjectSearchExpertConfig()

    def __init__(self, env: ObjectSearchEnv, _seed: int):
        self.skills = Skills(env)
        self.skills.gripper = 1.0

    def actions(self) -> Actions:
        """Actions of an episode, without end: in the end, the demonstrator holds the battery up."""
        skills, config = self.skills, self.config
        grasp_height = CONTAINER_FLOOR + BATTERY_SIZE / 2 + config.grasp_above_centre
        middle = np.array([*CONTAINER_XY, config.crossing_height])
        for place in (0, 1, 0, 1):
            over = np.array([CONTAINER_XY[0] + PLACES_X[place], CONTAINER_XY[1], config.hover_height])
            yield from skills.reach(over, DOWNWARD, config.free_tolerance)
            yield from skills.reach(np.array([*over[:2], grasp_height]), DOWNWARD, config.grasp_tolerance)
            if (yield from skills.close_until_felt(-1.0, config.felt_force, config.grip_steps)):
                break
            skills.gripper = 1.0  # opens while the hand leaves: at the place, open fingers would look as before the grasp
            yield from skills.reach(middle, DOWNWARD, config.crossing_tolerance)
        yield from skills.lift_and_hold(config.lift_height, DOWNWARD)
