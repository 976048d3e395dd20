"""Demonstrator of the screwing tasks: set the thread down, turn, and where the wrist ends let go, turn back, take it again."""

import numpy as np
from scipy.spatial.transform import Rotation

from manifeel_ms3.tasks.registry import register_demonstrator
from manifeel_ms3.tasks.screwing.base import WOUND_UP, ScrewingEnv

from .skills import DOWNWARD, Actions, Skills, position_rotation, seen

HOVER, CLEAR = 0.010, 0.020  # m over where the threads meet: where it begins to feel its way; where it may move sideways
SWEEP = np.deg2rad(310)  # that the wrist has
TURN = 0.047  # rad a step
PUSH = 1.5  # N, downwards, while it turns
CENTRE_PUSH, CENTRE_STEPS, CENTRE_TRIES, SUNK = 4.0, 3, 15, 5e-5  # N, steps, how often, m
ON_THREAD = 0.0015  # m over where the threads meet: higher up it is not on the thread yet
YIELD = 1.0e-4  # m/N a step: how the hand goes after a force that it does not want
SIDEWAYS = 1.0  # N that it bears
STEP = 8e-4  # m, at most, of a step under force
OPEN_BY = 0.007  # m on each side, to let go
STRAIGHTEN = 0.2  # of its lean, a step
RUB, SLOW_TURN = 0.03, 0.02  # N m from which it turns slower; rad a step
TIGHTEN = 0.16  # N m, at which it stops turning and holds


@register_demonstrator("ManiFeel-NutBoltAssembly-v1", "ManiFeel-BulbInstallation-v1")
class ScrewingExpert:
    """Knows the parts, sees roughly where the axis is, and goes by the loads that the pads feel."""

    def __init__(self, env: ScrewingEnv, seed: int):
        self.env, self.screw = env, env.screw
        self.skills = Skills(env)
        self._closed = self.skills.grip_action(self.screw.grip_width, self.screw.grip_force)
        self._open = self.skills.finger_action(self.screw.grip_width / 2 + OPEN_BY)
        self.skills.gripper = self._closed
        self.axis = seen(env.fixed, np.random.default_rng([seed, 17]))
        self.yaw = WOUND_UP

    def _facing(self) -> Rotation:
        return Rotation.from_euler("z", self.yaw) * DOWNWARD

    def actions(self) -> Actions:
        if self.env.start == "holder":
            yield from self._take()
        else:
            yield from self._set_down()
        while True:
            yield from self._turn(WOUND_UP - SWEEP)
            yield from self._regrasp()

    def _take(self) -> Actions:
        """Grasp what sits in its thread already."""
        skills = self.skills
        skills.gripper = 1.0
        place = self.axis + [0, 0, self.screw.engaged]
        yield from skills.reach(place + [0, 0, CLEAR], self._facing(), tolerance=2e-3)
        yield from skills.reach(place, self._facing(), tolerance=1.5e-3)
        yield from skills.move_fingers(self._closed, steps=6)
        skills.tare()

    def _set_down(self) -> Actions:
        """Bring the held part over the axis, lower it until it touches, and let it find its place."""
        skills = self.skills
        yield skills.command(*skills.commanded)
        skills.tare()
        over = self.axis + [0, 0, self.screw.engaged + HOVER]
        yield from skills.reach(over + [0, 0, CLEAR], self._facing(), tolerance=4e-3)
        yield from skills.reach(over, self._facing(), tolerance=1e-3)
        yield from skills.lower_until_contact(self._facing(), lowest=over[2] - 0.02, speed=0.001)
        yield from self._centre()

    def _centre(self) -> Actions:
        """Press, and go where the chamfer pushes the part, until it sinks no more, nor stands on the rim."""
        skills = self.skills
        lowest, deep_enough, tries = np.inf, self.screw.engaged + ON_THREAD, 0
        while self._height() < lowest - SUNK or self._height() > deep_enough and tries < CENTRE_TRIES:
            lowest, tries = self._height(), tries + 1
            for _ in range(CENTRE_STEPS):
                move = np.clip(2 * YIELD * (skills.load - [0, 0, CENTRE_PUSH]) + self._straighten(), -STEP, STEP)
                command, _ = skills.commanded
                yield skills.command(command + move, self._facing())

    def _turn(self, end: float) -> Actions:
        """Turn clockwise until the hand has turned to `end`, lightly pressing, giving way to what pushes sideways."""
        skills = self.skills
        while self.yaw > end:
            command, _ = skills.commanded
            load = skills.load
            load[:2] -= np.clip(load[:2], -SIDEWAYS, SIDEWAYS)
            move = np.clip(YIELD * (load - [0, 0, PUSH]) + self._straighten(), -STEP, STEP)
            felt = self._torque()
            turn = TURN if felt < RUB else SLOW_TURN * np.clip((TIGHTEN - felt) / (TIGHTEN - RUB), 0.0, 1.0)
            self.yaw -= turn
            move[2] -= self.screw.pitch * turn / (2 * np.pi)
            move[2] = min(move[2], 0.0)  # what it holds stays down
            yield skills.command(command + move, self._facing())

    def _straighten(self) -> np.ndarray:
        """How the hand moves, m a step, to stand up what leans in it, about the foot of its thread."""
        leaning = position_rotation(self.env.held.pose.raw_pose)[1].apply([0.0, 0.0, 1.0])
        return -STRAIGHTEN * self.screw.reach * np.r_[leaning[:2], 0.0]

    def _torque(self) -> float:
        """What the hand turns with, N m, clockwise, as the pads feel it."""
        return -float(self.env.agent.torque_on_held(self.env.agent.tcp.pose.p)[0])

    def _height(self) -> float:
        """Of the held part over the fixed one's underside, m, going by the hand's pose and the tactile images."""
        in_hand = (self.env.agent.tcp.pose.inv() * self.env.held.pose).raw_pose[0, :3].cpu().numpy()
        tool, facing = self.skills.tool
        return float((tool + facing.apply(in_hand) - self.axis)[2])

    def _regrasp(self) -> Actions:
        """Let go, turn back as far as is needed, or as far as the wrist goes, and close the fingers again."""
        skills = self.skills
        height = self._height()
        yield from skills.move_fingers(self._open, steps=3)
        here, _ = skills.tool
        left = (height - self.screw.seated) / self.screw.pitch * 2 * np.pi + self.screw.tightening
        alike = self.screw.symmetry
        back = self.yaw + alike * np.clip(np.ceil(left / alike), 1, np.floor(SWEEP / alike))
        while self.yaw < back:
            self.yaw = min(self.yaw + TURN, back)
            yield skills.command(here, self._facing())
        yield from skills.move_fingers(self._closed, steps=4)
        skills.tare()
