"""Demonstrator of BallSorting: grasp a ball, feel its surface, keep it if it has dimples, else let go and take the other."""

import cv2
import numpy as np

from manifeel_ms3.geometry.balls import SEAT_HEIGHT, SEAT_SPACING
from manifeel_ms3.sensors import TactileSensor, gelsight_r15
from manifeel_ms3.tasks.exploration.ball_sorting import BOWLS, BallSortingEnv
from manifeel_ms3.tasks.registry import register_demonstrator

from .skills import DOWNWARD, Actions, Skills, seen

GRASP_ABOVE = 0.004  # m over the ball's middle, clear of the stand
OVER = 0.075  # m over the ball's middle
ROUGH = 2.0  # grey levels that TacRGB varies within a millimetre, where something touches
GRAIN = 11  # pixels: a millimetre
LIFT_BY = 0.12  # m
IN_BOWL = 0.045  # m: tool height at which a ball hangs just over a bowl's floor


@register_demonstrator("ManiFeel-BallSorting-v1", "ManiFeel-BallSortingDim-v1")
class BallSortingExpert:
    """Sees two balls alike, guesses one, and decides on what TacRGB shows of the one it holds."""

    def __init__(self, env: BallSortingEnv, seed: int):
        self.env = env
        rng = np.random.default_rng([seed, 13])
        self.skills = Skills(env)
        self.skills.gripper = 1.0
        self.guess = int(rng.integers(2))
        self.stand = seen(env.stand, rng)
        self._pad = TactileSensor(gelsight_r15("feel", "gel_right"), env.scene, env.agent.robot, ("rgb",))
        self._untouched = self._look()

    def actions(self) -> Actions:
        yield from self._sort() if self.env.goal == "bowls" else self._take_golf_ball()

    def _take_golf_ball(self) -> Actions:
        for seat in (self.guess, 1 - self.guess, self.guess):
            yield from self._grasp(seat)
            if self.roughness() > ROUGH:
                break
            yield from self._let_go()
        yield from self.skills.lift_and_hold(LIFT_BY, DOWNWARD)

    def _sort(self) -> Actions:
        """Each ball into the bowl of its kind; what the first was not, the second is."""
        skills = self.skills
        kinds = ["golf", "tennis"]
        for seat in (self.guess, 1 - self.guess):
            yield from self._grasp(seat)
            kind = kinds[0] if len(kinds) == 1 or self.roughness() > ROUGH else "tennis"
            kinds.remove(kind)
            here, _ = skills.tool
            yield from skills.reach(here + [0, 0, OVER], DOWNWARD, tolerance=5e-3)
            (x, y), _ = BOWLS[kind]
            yield from skills.reach(np.array([x, y, here[2] + OVER]), DOWNWARD, tolerance=5e-3)
            yield from skills.reach(np.array([x, y, IN_BOWL]), DOWNWARD, tolerance=3e-3)
            yield from self._let_go()
        while True:
            yield skills.command(*skills.commanded)

    def _grasp(self, seat: int) -> Actions:
        ball = self.stand + [0.0, SEAT_SPACING * (seat - 0.5), SEAT_HEIGHT + GRASP_ABOVE]
        yield from self.skills.reach(ball + [0, 0, OVER], DOWNWARD, tolerance=2e-3)
        yield from self.skills.reach(ball, DOWNWARD, tolerance=1.5e-3)
        yield from self.skills.set_gripper(-0.4)

    def _let_go(self) -> Actions:
        here, _ = self.skills.tool
        yield from self.skills.set_gripper(1.0, steps=5)
        yield from self.skills.reach(here + [0, 0, OVER], DOWNWARD, tolerance=5e-3)

    def _look(self) -> np.ndarray:
        self._pad.capture()
        return self._pad.get_obs()["rgb"][0].cpu().numpy().astype(np.float32)

    def roughness(self) -> float:
        """How much the tactile image varies within a millimetre, grey levels, over what touches; 0 where nothing does."""
        change = self._look() - self._untouched
        smooth = cv2.GaussianBlur(change, (0, 0), GRAIN / 2)
        touching = np.abs(smooth).max(-1) > 4
        return float(np.abs(change - smooth)[touching].mean()) if touching.any() else 0.0
