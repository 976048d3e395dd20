"""Skills that the scripted demonstrators share: moving, pressing and sensing load.

A skill is a generator of actions, which reads the present state after each action that it yields. It commands the same
controller as a policy, within the same limits. The load that it acts on is the sum of the force fields of both pads.
"""

# pyright: reportAttributeAccessIssue=false
# (ManiSkill annotates a combined controller by its base class)
from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from mani_skill.utils.structs import Actor
from scipy.spatial.transform import Rotation

from manifeel_ms3.agents.controllers import LimitedLeadEEPoseController
from manifeel_ms3.agents.panda_gelsight import ACTION_AXES
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.tasks import VisuotactileEnv

Actions = Iterator[np.ndarray]
"""Actions of a demonstrator or of one of its skills."""
DOWNWARD = Rotation.from_euler("x", np.pi)
"""Orientation of a tool, or of a plug in it, that points straight down: its z axis points down."""
SMALLEST_NORM = 1e-9
"""Norm, m or rad, below which a displacement has no direction; it keeps divisions finite."""


@dataclass(frozen=True)
class SkillConfig:
    """Constants of the shared skills.

    Values without another origin were tuned by hand; docs/tasks.md has the success of each demonstrator and its seeds.
    """

    move_gain: float = 0.4
    """Share of the remaining distance that one step of a reach covers, so that the hand slows down at the end. Tuned."""
    top_speed: float = 0.008
    """Largest step of a reach, in m; the controller allows 0.01 (public code of the paper)."""
    top_turn: float = 0.04
    """Largest rotation of a reach in one step, in rad; the controller allows 0.05 (public code of the paper)."""
    speed_up: float = 0.002
    """Largest increase of a step's length over that of the step before, in m. Tuned."""
    angle_tolerance: float = 0.006
    """Orientation error, in rad, below which a reach has arrived. Tuned."""
    sight_error: float = 0.0015
    """Largest error of a position that a demonstrator sees, in m: about two pixels of the wrist camera."""
    reach_tolerance: float = 5e-4
    """Distance from the target, in m, at which a reach has arrived, unless the demonstrator gives another one. Tuned."""
    reach_steps: int = 80
    """Number of steps after which a reach ends although it has not arrived. Tuned."""
    gripper_steps: int = 6
    """Number of steps that the fingers get to close or to open. Tuned."""
    hold_tolerance: float = 2e-3
    """Distance from the height to which a part is lifted, in m, at which it is held still. Tuned."""
    contact_force: float = 2.0
    """Upward load, in N, at which a part that is being lowered has made contact. Tuned."""
    lowering_speed: float = 0.002
    """Speed at which a part is lowered to contact, in m per step. Tuned."""
    settle_steps: int = 2
    """Number of steps that the fingers get to come to rest after a motion at a steady pace. Tuned."""


CONFIG = SkillConfig()


class Skills:
    """Motion and sensed load of the robot of a single environment (`num_envs=1`); base frame, in m, rad and N.

    Raises:
        InvalidArgumentError: The actions of the control mode are no steps of the tool, or leave out the gripper in a task
            whose own control mode has it.
    """

    def __init__(self, env: VisuotactileEnv):
        _require_motions(env)
        self.env = env
        self.agent = env.agent
        self.arm = env.agent.controller.controllers["arm"]
        self._scale = np.r_[np.full(3, self.arm.config.pos_upper), np.full(3, self.arm.config.rot_upper)]
        self._speed = 0.0
        self._no_load, self._no_moment = np.zeros(3), np.zeros(3)
        self.gripper: float | None = None
        """Gripper command of every action, from 1 (open) to -1 (closed); None where the controller holds the gripper fixed."""

    # ---------------------------------------------------------------- sensing

    @property
    def tool(self) -> tuple[np.ndarray, Rotation]:
        """Measured position and orientation of the tool centre point."""
        return position_rotation(self.agent.tcp_pose_at_base.raw_pose)

    @property
    def commanded(self) -> tuple[np.ndarray, Rotation]:
        """Commanded position and orientation of the tool centre point, which the next action is relative to."""
        return position_rotation(self.arm.commanded_pose.raw_pose)

    @property
    def load(self) -> np.ndarray:
        """Force (3,), N, of the world on the held object, sensed by both pads, relative to the last `tare`."""
        return self._raw_load() - self._no_load

    def load_moment(self, point: np.ndarray) -> np.ndarray:
        """Moment (3,), N m, of the load about a point (3,), in m, in the base frame."""
        about_tool = self._raw_moment() - self._no_moment
        tool, _ = self.tool
        return about_tool + np.cross(tool - point, self.load)

    def tare(self) -> None:
        """Take the present load, which is the weight of the held object, as zero."""
        self._no_load, self._no_moment = self._raw_load(), self._raw_moment()

    def _raw_load(self) -> np.ndarray:
        total = np.zeros(3)
        for side, gel in self.agent.gels.items():
            force = self.agent.pad_wrench(side)[0, :3].cpu().numpy()
            _, pad = position_rotation(gel.pose.raw_pose)
            total += pad.apply(force)
        return total  # the held object transmits the world's force to the pads

    def _raw_moment(self) -> np.ndarray:
        """Moment (3,), N m, of both pads' forces about the tool centre point, base frame."""
        tool, _ = self.tool
        total = np.zeros(3)
        for side, gel in self.agent.gels.items():
            wrench = self.agent.pad_wrench(side)[0].cpu().numpy()
            place, pad = position_rotation(gel.pose.raw_pose)
            total += pad.apply(wrench[3:]) + np.cross(place - tool, pad.apply(wrench[:3]))
        return total

    @property
    def squeeze(self) -> np.ndarray:
        """Normal force (2,), N, on the left and the right pad."""
        return np.array([-float(self.agent.pad_wrench(side)[0, 2]) for side in ("left", "right")])

    # ---------------------------------------------------------------- moving

    def command(self, position: np.ndarray, rotation: Rotation) -> np.ndarray:
        """Action (6,), or (7,) with a gripper, that moves the controller's target to a pose, or as near as the limits allow.

        The action is shorter where the controller turns about fewer axes.
        """
        here, facing = self.commanded
        twist = np.r_[position - here, (rotation * facing.inv()).as_rotvec()]
        twist[[3 + axis for axis in self.arm.config.locked_axes]] = 0.0
        return self.with_grip(self.of_controlled_axes(np.clip(twist / self._scale, -1.0, 1.0)))

    def of_controlled_axes(self, motion: np.ndarray) -> np.ndarray:
        """The components of a motion (6,) for which the controller has actions."""
        return motion[[0, 1, 2, *(3 + axis for axis in self.arm.config.rotation_axes)]]

    def with_grip(self, motion: np.ndarray) -> np.ndarray:
        """An action that consists of a motion of the tool and the gripper command, if there is one."""
        return motion if self.gripper is None else np.r_[motion, self.gripper]

    def keep_grip(self) -> None:
        """Command the gripper, where it has an action, to keep its present grip as far as its range allows."""
        if self.agent.controller.controllers["gripper"].single_action_space.shape[0]:
            self.gripper = self.present_grip

    def towards(self, rotation: Rotation, rate: float) -> Rotation:
        """The commanded orientation, turned towards another one by at most `rate`, in rad."""
        _, facing = self.commanded
        way = (rotation * facing.inv()).as_rotvec()
        return Rotation.from_rotvec(way * min(1.0, rate / max(np.linalg.norm(way), SMALLEST_NORM))) * facing

    def stride(self, position: np.ndarray, rotation: Rotation) -> np.ndarray:
        """Action for one step of a reach towards a pose; a reach accelerates at first and slows down at the end."""
        here, facing = self.commanded
        way, turn = position - here, (rotation * facing.inv()).as_rotvec()
        distance, angle = np.linalg.norm(way), np.linalg.norm(turn)
        self._speed = min(CONFIG.move_gain * distance, CONFIG.top_speed, self._speed + CONFIG.speed_up)
        pace = self._speed / distance if distance > SMALLEST_NORM else 1.0
        sweep = min(CONFIG.move_gain, CONFIG.top_turn / angle) if angle > SMALLEST_NORM else 1.0
        return self.command(here + pace * way, Rotation.from_rotvec(sweep * turn) * facing)

    def reach(self, position: np.ndarray, rotation: Rotation, tolerance: float = CONFIG.reach_tolerance) -> Actions:
        """Move to a pose through free space, until within `tolerance`, in m, or for `reach_steps`."""
        self._speed = 0.0
        for _ in range(CONFIG.reach_steps):
            here, facing = self.tool
            arrived = np.linalg.norm(position - here) < tolerance
            if arrived and (rotation * facing.inv()).magnitude() < CONFIG.angle_tolerance:
                return
            yield self.stride(position, rotation)

    def hold_still(self) -> Actions:
        """Repeat the present command without end."""
        while True:
            yield self.command(*self.commanded)

    def set_gripper(self, opening: float, steps: int = CONFIG.gripper_steps) -> Actions:
        """Stay in place and command the gripper, from 1 (open) to -1 (closed)."""
        self.gripper = opening
        for _ in range(steps):
            yield self.command(*self.commanded)

    def close_until_felt(self, opening: float, force: float, steps: int) -> Generator[np.ndarray, None, bool]:
        """Stay in place and close the gripper until both pads feel a force.

        Args:
            opening: Gripper command, from 1 (open) to -1 (closed).
            force: Normal force on each pad, in N.
            steps: Largest number of steps.

        Returns:
            Whether both pads feel more than `force`; the fingers then close no further.
        """
        for _ in range(steps):
            yield from self.set_gripper(opening, steps=1)
            if self.squeeze.min() > force:
                return True
        return False

    def move_fingers(self, opening: float, steps: int) -> Actions:
        """Stay in place and move the gripper to a command in so many steps, at a steady pace; then let it come to rest."""
        start = self.gripper or 0.0
        for step in range(steps + CONFIG.settle_steps):
            yield from self.set_gripper(start + (opening - start) * min((step + 1) / steps, 1.0), steps=1)

    def finger_action(self, position: float) -> float:
        """Gripper command that moves each finger to a distance from the middle, in m."""
        limits = self.agent.controller.controllers["gripper"].config
        return float(np.clip((position - limits.lower) / (limits.upper - limits.lower) * 2 - 1, -1, 1))

    @property
    def present_grip(self) -> float:
        """Gripper command that keeps the fingers' present target; the firmest one if the target is beyond their range."""
        finger = self.agent.controller.controllers["gripper"].active_joint_indices[0]
        return self.finger_action(float(self.agent.robot.get_drive_targets()[0, finger]))

    def grip_action(self, width: float, force: float) -> float:
        """Gripper command that presses each finger with `force`, in N, on an object `width` wide, in m."""
        return self.finger_action(width / 2 - force / self.agent.controller.controllers["gripper"].config.stiffness)

    def lift_and_hold(self, height: float, rotation: Rotation) -> Actions:
        """Raise the held object by `height`, in m; then hold it there without end."""
        here, _ = self.tool
        yield from self.reach(above(here, height), rotation, CONFIG.hold_tolerance)
        yield from self.hold_still()

    def lower_until_contact(self, rotation: Rotation, lowest: float, speed: float = CONFIG.lowering_speed) -> Actions:
        """Go straight down by `speed`, in m per step, until the load exceeds `contact_force` or the tool is at `lowest`."""
        while True:
            here, _ = self.commanded
            tool, _ = self.tool
            if self.load[2] > CONFIG.contact_force or tool[2] < lowest:
                return
            yield self.command(above(here, -speed), rotation)


def above(position: np.ndarray, height: float) -> np.ndarray:
    """The point `height`, in m, above a position (3,)."""
    return position + np.array([0.0, 0.0, height])


def perceived_position(actor: Actor, rng: np.random.Generator) -> np.ndarray:
    """Position (3,), m, base frame, of an actor as a demonstrator sees it: up to `sight_error` off in a random direction.

    The true position is read from the simulator, and the error added to it.
    """
    position, _ = position_rotation(actor.pose.raw_pose)
    return position + aside(rng, CONFIG.sight_error)


def aside(rng: np.random.Generator, largest: float) -> np.ndarray:
    """A random horizontal vector (3,) of at most a length; its end is uniform in the disc."""
    angle, length = rng.uniform(0, 2 * np.pi), largest * np.sqrt(rng.uniform())
    return length * np.array([np.cos(angle), np.sin(angle), 0.0])


def _require_motions(env: VisuotactileEnv) -> None:
    """Check that actions of the environment's control mode can do what a demonstrator of its task does."""
    needs_gripper = "gripper" in ACTION_AXES.get(env.default_control_mode, ())
    arm, gripper = (env.agent.controller.controllers[part] for part in ("arm", "gripper"))
    moves_tool = isinstance(arm, LimitedLeadEEPoseController) and arm.config.use_delta
    if not moves_tool or (needs_gripper and not gripper.single_action_space.shape[0]):
        modes = [mode for mode, axes in ACTION_AXES.items() if "gripper" in axes or not needs_gripper]
        raise InvalidArgumentError(
            f"control_mode={env.control_mode!r}: demonstrators of {type(env).__name__} move the tool by steps"
            f"{', and the fingers' if needs_gripper else ''}; choose from {modes}, and convert the actions afterwards by "
            "`manifeel render-observations --control-mode`"
        )


def position_rotation(raw_pose: torch.Tensor) -> tuple[np.ndarray, Rotation]:
    """Position and rotation of the only environment, from a pose (1, 7)."""
    pose = raw_pose[0].cpu().numpy().astype(np.float64)
    return pose[:3], Rotation.from_quat(pose[[4, 5, 6, 3]])  # SAPIEN has w first
