"""Demonstrator of BallSorting: grasp a ball, feel its surface, keep it if it has dimples; otherwise take the other one."""

from dataclasses import dataclass

import cv2
import numpy as np

from manifeel_ms3.geometry.balls import SEAT_HEIGHT, SEAT_SPACING
from manifeel_ms3.sensors import OpticsConfig, TactileSensor, sensor_config
from manifeel_ms3.tasks.exploration.ball_sorting import BOWLS, BallSortingEnv
from manifeel_ms3.tasks.registry import register_demonstrator

from .skills import DOWNWARD, Actions, Skills, above, perceived_position


@dataclass(frozen=True)
class BallSortingExpertConfig:
    """Constants of the demonstrator of BallSorting.

    Values without another origin were tuned by hand; docs/tasks.md has the success over seeds 0 to 99.
    """

    grasp_above_centre: float = 0.004
    """Height of the tool over the ball's centre at the grasp, in m: the fingers are clear of the stand."""
    hover_height: float = 0.075
    """Height of the tool over the ball's centre before and after a grasp, in m: the fingertips are clear of the ball. Tuned."""
    grip: float = -0.4
    """Gripper command that closes on a ball, between 1 (open) and -1 (closed). Tuned."""
    rough: float = 2.0
    """Roughness of the tactile image, in grey levels, above which the ball has dimples. Tuned."""
    grain: float = 11.0
    """Length over which roughness is taken, in pixels of TacRGB: one millimetre."""
    touching: float = 4.0
    """Change of the smoothed tactile image, in grey levels, above which a pixel is in contact. Tuned."""
    lift_height: float = 0.12
    """Distance by which the golf ball is lifted, in m: the goal of 0.10 m with a margin."""
    release_height: float = 0.045
    """Height of the tool over the table, in m, at which a held ball is just over the floor of a bowl."""
    open_steps: int = 5
    """Number of steps for which the gripper opens. Tuned."""
    free_tolerance: float = 5e-3
    """Distance from a target in free space at which the hand goes on, in m. Tuned."""
    bowl_tolerance: float = 3e-3
    """Distance from the release position at which the hand opens, in m. Tuned."""
    approach_tolerance: float = 2e-3
    """Distance from the point over a ball at which the hand goes down, in m. Tuned."""
    grasp_tolerance: float = 1.5e-3
    """Distance from the grasp position at which the fingers close, in m. Tuned."""


@register_demonstrator("ManiFeel-BallSorting-v1", "ManiFeel-BallSortingDim-v1")
class BallSortingExpert:
    """Cannot tell the two balls apart by sight; it grasps one of them and decides by the TacRGB image of its surface."""

    config = BallSortingExpertConfig()

    def __init__(self, env: BallSortingEnv, seed: int):
        self.env = env
        rng = np.random.default_rng([seed, 13])
        self.skills = Skills(env)
        self.skills.gripper = 1.0
        self.guess = int(rng.integers(2))
        self.stand = perceived_position(env.stand, rng)
        # whatever the sensor, in the colours that `rough` and `touching` are tuned for
        pad = sensor_config(env.sensor, "feel", "gel_right", optics=OpticsConfig())
        self._pad = TactileSensor(pad, env.scene, env.agent.robot, ("rgb",))
        self._untouched = self._tactile_image()

    def actions(self) -> Actions:
        """Actions of one episode, without end: at last the demonstrator holds its pose."""
        yield from self._sort() if self.env.goal == "bowls" else self._take_golf_ball()

    def _take_golf_ball(self) -> Actions:
        for seat in (self.guess, 1 - self.guess, self.guess):
            yield from self._grasp(seat)
            if self.roughness() > self.config.rough:
                break
            yield from self._let_go()
        yield from self.skills.lift_and_hold(self.config.lift_height, DOWNWARD)

    def _sort(self) -> Actions:
        """Put each ball into the bowl of its kind; the second ball is of the kind that the first one was not."""
        skills, config = self.skills, self.config
        kinds = ["golf", "tennis"]
        for seat in (self.guess, 1 - self.guess):
            yield from self._grasp(seat)
            kind = kinds[0] if len(kinds) == 1 or self.roughness() > config.rough else "tennis"
            kinds.remove(kind)
            here, _ = skills.tool
            yield from skills.reach(above(here, config.hover_height), DOWNWARD, config.free_tolerance)
            (x, y), _ = BOWLS[kind]
            yield from skills.reach(np.array([x, y, here[2] + config.hover_height]), DOWNWARD, config.free_tolerance)
            yield from skills.reach(np.array([x, y, config.release_height]), DOWNWARD, config.bowl_tolerance)
            yield from self._let_go()
        yield from skills.hold_still()

    def _grasp(self, seat: int) -> Actions:
        config = self.config
        ball = self.stand + np.array([0.0, SEAT_SPACING * (seat - 0.5), SEAT_HEIGHT + config.grasp_above_centre])
        yield from self.skills.reach(above(ball, config.hover_height), DOWNWARD, config.approach_tolerance)
        yield from self.skills.reach(ball, DOWNWARD, config.grasp_tolerance)
        yield from self.skills.set_gripper(config.grip)

    def _let_go(self) -> Actions:
        here, _ = self.skills.tool
        yield from self.skills.set_gripper(1.0, self.config.open_steps)
        yield from self.skills.reach(above(here, self.config.hover_height), DOWNWARD, self.config.free_tolerance)

    def _tactile_image(self) -> np.ndarray:
        self._pad.capture()
        return self._pad.get_obs()["rgb"][0].cpu().numpy().astype(np.float32)

    def roughness(self) -> float:
        """Mean variation of the tactile image within a millimetre, in grey levels, over the contact; 0 without contact."""
        change = self._tactile_image() - self._untouched
        smooth = cv2.GaussianBlur(change, (0, 0), self.config.grain / 2)
        touching = np.abs(smooth).max(-1) > self.config.touching
        return float(np.abs(change - smooth)[touching].mean()) if touching.any() else 0.0
