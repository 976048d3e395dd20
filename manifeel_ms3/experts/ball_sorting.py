"""Demonstrator of BallSorting: grasp a ball, feel its surface, keep it if it has dimples, else let go and take the other."""

import cv2
import numpy as np

from manifeel_ms3.geometry.balls import SEAT_HEIGHT, SEAT_SPACING
from manifeel_ms3.sensors import TactileSensor, gelsight_r15
from manifeel_ms3.tasks.ball_sorting import BallSortingEnv

from .skills import DOWNWARD, SIGHT_ERROR, Actions, Skills

GRASP_ABOVE = 0.004  # m over the ball's middle, clear of the stand
OVER = 0.075  # m over the ball's middle
ROUGH = 2.0  # grey levels that TacRGB varies within a millimetre, where something touches
GRAIN = 11  # pixels: a millimetre
LIFT_BY = 0.12  # m


class BallSortingExpert:
    """Sees two balls alike, guesses one, and decides on what TacRGB shows of the one it holds."""

    def __init__(self, env: BallSortingEnv, seed: int):
        rng = np.random.default_rng([seed, 13])
        self.skills = Skills(env)
        self.skills.gripper = 1.0
        self.guess = int(rng.integers(2))
        stand = env.stand.pose.raw_pose[0, :3].cpu().numpy().astype(np.float64)
        self.stand = stand + np.r_[rng.uniform(-1, 1, 2) * SIGHT_ERROR, 0.0]
        self._pad = TactileSensor(gelsight_r15("feel", "gel_right"), env.scene, env.agent.robot, ("rgb",))
        self._untouched = self._look()

    def actions(self) -> Actions:
        skills = self.skills
        for seat in (self.guess, 1 - self.guess, self.guess):
            ball = self.stand + [0.0, SEAT_SPACING * (seat - 0.5), SEAT_HEIGHT + GRASP_ABOVE]
            yield from skills.reach(ball + [0, 0, OVER], DOWNWARD, tolerance=2e-3)
            yield from skills.reach(ball, DOWNWARD, tolerance=1.5e-3)
            yield from skills.set_gripper(-0.4)
            if self.roughness() > ROUGH:
                break
            yield from skills.set_gripper(1.0, steps=5)
            yield from skills.reach(ball + [0, 0, OVER], DOWNWARD, tolerance=5e-3)
        yield from skills.lift_and_hold(LIFT_BY, DOWNWARD)

    def _look(self) -> np.ndarray:
        self._pad.capture()
        return self._pad.get_obs()["rgb"][0].cpu().numpy().astype(np.float32)

    def roughness(self) -> float:
        """How much the tactile image varies within a millimetre, grey levels, over what touches; 0 where nothing does."""
        change = self._look() - self._untouched
        smooth = cv2.GaussianBlur(change, (0, 0), GRAIN / 2)
        touching = np.abs(smooth).max(-1) > 4
        return float(np.abs(change - smooth)[touching].mean()) if touching.any() else 0.0
