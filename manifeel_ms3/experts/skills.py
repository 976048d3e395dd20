"""Skills that scripted demonstrators share: moving, pressing, feeling.

A skill is a generator that yields actions and sees the world anew after each. It commands the same controller as a policy
does, within the same limits, and feels through the pads: the load it acts on is the sum of both force fields.
"""

from collections.abc import Iterator

import numpy as np
from mani_skill.utils.structs import Actor
from scipy.spatial.transform import Rotation

from manifeel_ms3.tasks import VisuotactileEnv

Actions = Iterator[np.ndarray]
MOVE_GAIN = 0.4  # share of the remaining way that a step covers: a reach that slows down towards its end, as a hand's does
TOP_SPEED = 0.008  # m a step; actions reach 0.01
TOP_TURN = 0.04  # rad a step; actions reach 0.05
SPEED_UP = 0.002  # m a step more than the step before, at most
SIGHT_ERROR = 0.0015  # m: how far off the eye places a thing, about two pixels of the wrist camera
DOWNWARD = Rotation.from_euler("x", np.pi)  # of the tool, and of a plug in it: frames with their z down


class Skills:
    """Motion and feeling of one robot in one environment (`num_envs=1`), in its base frame, m, rad and N."""

    def __init__(self, env: VisuotactileEnv):
        self.env = env
        self.agent = env.agent
        self.arm = env.agent.controller.controllers["arm"]
        self._scale = np.r_[np.full(3, self.arm.config.pos_upper), np.full(3, self.arm.config.rot_upper)]
        self._speed = 0.0
        self._no_load = np.zeros(3)
        self.gripper: float | None = None
        """What actions command the gripper to do, 1 open to -1 closed; None where the controller holds it fixed."""

    # ---------------------------------------------------------------- what is seen and felt

    @property
    def tool(self) -> tuple[np.ndarray, Rotation]:
        """Where the tool is."""
        return position_rotation(self.agent.tcp_pose_at_base.raw_pose)

    @property
    def commanded(self) -> tuple[np.ndarray, Rotation]:
        """Where the next action counts from."""
        return position_rotation(self.arm.commanded_pose.raw_pose)

    @property
    def load(self) -> np.ndarray:
        """Force (3,) of the world on what the fingers hold, felt by both pads, since `tare`."""
        return self._raw_load() - self._no_load

    def tare(self) -> None:
        """Take the present load, the held object's weight, as zero."""
        self._no_load = self._raw_load()

    def _raw_load(self) -> np.ndarray:
        total = np.zeros(3)
        for side, gel in self.agent.gels.items():
            force = self.agent.pad_wrench(side)[0, :3].cpu().numpy()
            _, pad = position_rotation(gel.pose.raw_pose)
            total += pad.apply(force)
        return total  # the object passes on to the pads what the world does to it

    @property
    def squeeze(self) -> np.ndarray:
        """Normal force (2,), N, that the left and the right pad feel."""
        return np.array([-float(self.agent.pad_wrench(side)[0, 2]) for side in ("left", "right")])

    # ---------------------------------------------------------------- moving

    def command(self, position: np.ndarray, rotation: Rotation) -> np.ndarray:
        """Action (6,), or (7,) with a gripper, that puts the controller's target at a pose, or as near as the limits allow.

        It is shorter where the controller turns about fewer axes.
        """
        here, facing = self.commanded
        twist = np.r_[position - here, (rotation * facing.inv()).as_rotvec()]
        action = np.clip(twist / self._scale, -1.0, 1.0)[[0, 1, 2, *(3 + axis for axis in self.arm.config.rotation_axes)]]
        return action if self.gripper is None else np.r_[action, self.gripper]

    def towards(self, rotation: Rotation, rate: float) -> Rotation:
        """Orientation of the command, turned towards another by `rate` rad at most."""
        _, facing = self.commanded
        way = (rotation * facing.inv()).as_rotvec()
        return Rotation.from_rotvec(way * min(1.0, rate / max(np.linalg.norm(way), 1e-9))) * facing

    def stride(self, position: np.ndarray, rotation: Rotation, top_speed: float = TOP_SPEED) -> np.ndarray:
        """Action (6,) of a reach towards a pose: gathers speed, slows down at the end."""
        here, facing = self.commanded
        way, turn = position - here, (rotation * facing.inv()).as_rotvec()
        distance, angle = np.linalg.norm(way), np.linalg.norm(turn)
        self._speed = min(MOVE_GAIN * distance, top_speed, self._speed + SPEED_UP)
        pace = self._speed / distance if distance > 1e-9 else 1.0
        sweep = min(MOVE_GAIN, TOP_TURN / angle) if angle > 1e-9 else 1.0
        return self.command(here + pace * way, Rotation.from_rotvec(sweep * turn) * facing)

    def reach(self, position: np.ndarray, rotation: Rotation, tolerance: float = 5e-4, steps: int = 80) -> Actions:
        """Move to a pose through free space."""
        self._speed = 0.0
        for _ in range(steps):
            here, facing = self.tool
            if np.linalg.norm(position - here) < tolerance and (rotation * facing.inv()).magnitude() < 0.006:
                return
            yield self.stride(position, rotation)

    def set_gripper(self, opening: float, steps: int = 6) -> Actions:
        """Stay, and move the gripper: 1 open to -1 closed."""
        self.gripper = opening
        for _ in range(steps):
            yield self.command(*self.commanded)

    def move_fingers(self, opening: float, steps: int) -> Actions:
        """Stay, and move the gripper at a steady pace; then give it two steps to come to rest."""
        start = self.gripper or 0.0
        for step in range(steps + 2):
            yield from self.set_gripper(start + (opening - start) * min((step + 1) / steps, 1.0), steps=1)

    def finger_action(self, position: float) -> float:
        """What commands each finger to a place, m from the middle."""
        limits = self.agent.controller.controllers["gripper"].config
        return float(np.clip((position - limits.lower) / (limits.upper - limits.lower) * 2 - 1, -1, 1))

    def grip_action(self, width: float, force: float) -> float:
        """What presses each finger with a force, N, on something this wide, m."""
        return self.finger_action(width / 2 - force / self.agent.controller.controllers["gripper"].config.stiffness)

    def lift_and_hold(self, height: float, rotation: Rotation) -> Actions:
        """Raise what is held by `height`, m; then stay, without end."""
        here, _ = self.tool
        yield from self.reach(here + [0.0, 0.0, height], rotation, tolerance=2e-3)
        while True:
            yield self.command(*self.commanded)

    def lower_until_contact(self, rotation: Rotation, lowest: float, threshold: float = 2.0, speed: float = 0.002) -> Actions:
        """Go straight down until something pushes back, or the tool is at height `lowest`."""
        while True:
            here, _ = self.commanded
            tool, _ = self.tool
            if self.load[2] > threshold or tool[2] < lowest:
                return
            yield self.command(here - [0.0, 0.0, speed], rotation)


def seen(actor: Actor, rng: np.random.Generator) -> np.ndarray:
    """Where a thing seems to be, (3,), m, base frame: up to SIGHT_ERROR off, to any side."""
    angle, radius = rng.uniform(0, 2 * np.pi), SIGHT_ERROR * np.sqrt(rng.uniform())
    position, _ = position_rotation(actor.pose.raw_pose)
    return position + radius * np.array([np.cos(angle), np.sin(angle), 0.0])


def position_rotation(raw_pose) -> tuple[np.ndarray, Rotation]:
    """Of the only environment, from a pose (1, 7)."""
    pose = raw_pose[0].cpu().numpy().astype(np.float64)
    return pose[:3], Rotation.from_quat(pose[[4, 5, 6, 3]])  # SAPIEN has w first
