"""Controllers for contact: a pose target with a limited lead over the tool, and a gripper that keeps its grip.

The arm follows pose targets that accumulate, so that free motion is precise: a commanded millimetre is a millimetre. Before
each command, the target is pulled back until it leads the tool's actual pose by at most the target lead limit. This bounds
the contact force by that limit times the joint stiffness, whatever the policy asks for, as with a task-space impedance.
"""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# (ManiSkill annotates actions and joint positions as unions of arrays, sequences and dicts; here they are tensors)

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from gymnasium import spaces
from mani_skill.agents.controllers import (
    PDEEPoseController,
    PDEEPoseControllerConfig,
    PDJointPosController,
    PDJointPosControllerConfig,
)
from mani_skill.agents.controllers.utils.kinematics import Kinematics
from mani_skill.utils import common
from mani_skill.utils.geometry.rotation_conversions import (
    axis_angle_to_quaternion,
    euler_angles_to_matrix,
    matrix_to_quaternion,
    quaternion_invert,
    quaternion_multiply,
    quaternion_to_axis_angle,
)
from mani_skill.utils.structs import Pose

IK_TOLERANCE = 1e-7
"""Norm of the pose error, in m and rad, at which inverse kinematics has converged: the resolution of single precision."""
IK_ITERATIONS = 30
"""Largest number of Gauss-Newton iterations; a control step takes only a few. Set once; not tuned."""
GPU_IK_STEPS = 3
"""Number of Levenberg-Marquardt steps for an action on a GPU: one step misses targets that lead by 16 mm and 0.09 rad by up to
6 mm, and three by less than 2 micrometres."""


def clamp_norm(vector: torch.Tensor, limit: float) -> torch.Tensor:
    """Vectors (N, D) like those of `vector`, the ones that are longer than `limit` shortened to it."""
    norm = torch.linalg.norm(vector, dim=-1, keepdim=True)
    return vector * (limit / norm.clamp(min=limit))


def rotation_between(start: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
    """Rotation vector (N, 3), rad, that turns the quaternion `start` (N, 4), w first, into `end`, in the frame of both."""
    turn = quaternion_multiply(end, quaternion_invert(start))
    turn = torch.where(turn[:, :1] < 0, -turn, turn)  # of the two rotations, the shorter one
    return quaternion_to_axis_angle(turn)


def solve_ik(kinematics: Kinematics, pose: Pose, q0: torch.Tensor, iterations: int = GPU_IK_STEPS) -> torch.Tensor:
    """Arm joint angles (N, 7), in rad, that put the tool at a pose, by inverse kinematics.

    On a GPU this takes `iterations` Levenberg-Marquardt steps; on the CPU, Gauss-Newton runs to convergence. Where no solution
    is found, the last iterate is returned, so that the arm does not stop at a target that is out of reach.

    Args:
        kinematics: Kinematics of the arm.
        pose: Poses (N,) of the tool in the base frame; N is 1 on the CPU.
        q0: Joint positions (N, 9) of the whole robot, in rad and m.
        iterations: Number of steps on a GPU.
    """
    joints = kinematics.active_joint_indices
    lowest, highest = kinematics.articulation.get_qlimits()[0, joints].unbind(-1)  # those of all environments
    if kinematics.use_gpu_ik:
        q = q0.clone()
        for _ in range(iterations):
            q[:, joints] = kinematics.compute_ik(pose, q)
            q[:, joints] = q[:, joints].clamp(lowest, highest)
        return q[:, joints]
    start = q0[0, kinematics.pmodel_active_joint_indices].cpu().numpy()
    # dt = 1 makes the damped iteration Gauss-Newton; with ManiSkill's 0.1, it stops 0.1 mm short
    solution, _, _ = kinematics.pmodel.compute_inverse_kinematics(
        kinematics.end_link_idx, pose.sp, start, kinematics.qmask, eps=IK_TOLERANCE, max_iterations=IK_ITERATIONS, dt=1.0
    )
    q = common.to_tensor(solution[kinematics.pmodel_controlled_joint_indices], device=kinematics.device).float()
    return q[None].clamp(lowest, highest)


class LimitedLeadEEPoseController(PDEEPoseController):
    """Pose control of the tool about the base frame's axes; the target's lead over the tool is limited.

    A delta action of +-1 maps to `pos_upper` metres along and `rot_upper` radians about each axis of the base frame, right-hand
    rule. An absolute action (`use_delta=False`) is ManiSkill's: position in m, and Euler angles XYZ in rad.
    """

    config: "LimitedLeadEEPoseControllerConfig"

    def _initialize_action_space(self):
        rotations = len(self.config.rotation_axes)
        high = np.r_[np.full(3, self.config.pos_upper), np.full(rotations, self.config.rot_upper)].astype(np.float32)
        self.single_action_space = spaces.Box(-high, high, dtype=np.float32)

    def _clip_and_scale_action_space(self):
        super()._clip_and_scale_action_space()
        self._scale = self.action_space_high
        # ManiSkill's conversion of actions (`from_pd_joint_pos_to_ee`), which divides by these bounds, assumes that
        # rotations are reversed, as in its own controllers
        sign = torch.ones_like(self._scale)
        sign[3:] = -1.0
        self.action_space_low, self.action_space_high = self.action_space_low * sign, self.action_space_high * sign

    def _clip_and_scale_action(self, action):
        # not ManiSkill's scaling, which multiplies rotations by their lower bound and so reverses their sign
        return action.clamp(-1.0, 1.0) * self._scale

    def set_action(self, action):
        action = self._preprocess_action(action)
        self._target_pose = self._moved(action) if self.config.use_delta else self._absolute(action)
        self.set_drive_targets(solve_ik(self.kinematics, self._target_pose, self.articulation.get_qpos()))

    def _moved(self, delta: torch.Tensor) -> Pose:
        """The commanded pose, moved by a delta in m and rad."""
        turn = delta.new_zeros(len(delta), 3)
        turn[:, list(self.config.rotation_axes)] = delta[:, 3:]
        turn[:, list(self.config.locked_axes)] = 0.0
        base = self.commanded_pose
        return Pose.create_from_pq(base.p + delta[:, :3], quaternion_multiply(axis_angle_to_quaternion(turn), base.q))

    def _absolute(self, action: torch.Tensor) -> Pose:
        """The pose of an absolute action (m, and Euler angles in rad), its lead over the tool limited."""
        rotation = matrix_to_quaternion(euler_angles_to_matrix(action[:, 3:], "XYZ"))
        return self._limit_lead(Pose.create_from_pq(action[:, :3], rotation), self.ee_pose_at_base)

    @property
    def commanded_pose(self) -> Pose:
        """Pose (base frame) that the next action is relative to: the last target, its lead over the tool limited."""
        return self._limit_lead(self._target_pose, self.ee_pose_at_base)

    def _limit_lead(self, target: Pose, current: Pose) -> Pose:
        turn = clamp_norm(rotation_between(current.q, target.q), self.config.target_lead_limit_rot)
        return Pose.create_from_pq(
            current.p + clamp_norm(target.p - current.p, self.config.target_lead_limit_pos),
            quaternion_multiply(axis_angle_to_quaternion(turn), current.q),
        )

    def set_state(self, state: dict):
        if state:  # the state of some controllers is empty
            self._target_pose = Pose.create(state["target_pose"])
            if not self.scene.gpu_sim_enabled:  # on a GPU, the next action sets the drives of all environments
                self.set_drive_targets(solve_ik(self.kinematics, self._target_pose, self.articulation.get_qpos()))


@dataclass
class LimitedLeadEEPoseControllerConfig(PDEEPoseControllerConfig):
    """Configuration of `LimitedLeadEEPoseController`. Ranges are symmetric: their lower ends follow from the upper ones."""

    pos_lower: float = field(init=False)
    """Translation of a delta action of -1, in m; lowest coordinate of an absolute action."""
    pos_upper: float = 0.01
    """Translation of a delta action of 1, in m (public code of the paper); highest coordinate of an absolute action."""
    rot_lower: float = field(init=False)
    """Rotation of a delta action of -1, in rad; lowest angle of an absolute action."""
    rot_upper: float = 0.05
    """Rotation of a delta action of 1, in rad (public code of the paper); highest angle of an absolute action."""
    rotation_axes: Sequence[int] = (0, 1, 2)
    """Axes of the base frame that have a rotation action; (2,) is yaw only."""
    locked_axes: Sequence[int] = ()
    """Axes of the base frame whose rotation action is ignored, as the paper's public code sets it to zero."""
    target_lead_limit_pos: float = 0.006
    """Largest lead of the target over the tool before a delta is added, or of an absolute target, in m. The arm lags at full
    speed by 5.8 mm (joint time constant 0.1 s at 10 Hz), so that free motion is never held back; in contact the limit bounds
    the force near 16 N."""
    target_lead_limit_rot: float = 0.04
    """Largest lead of the target over the tool in rotation, in rad. Set once; not tuned."""
    use_target: bool = field(init=False, default=True)
    """Delta actions are always relative to the last target."""
    controller_cls = LimitedLeadEEPoseController

    def __post_init__(self):
        self.pos_lower, self.rot_lower = -self.pos_upper, -self.rot_upper


class HoldGripperController(PDJointPosController):
    """A gripper without an action, which keeps the grip that the robot was reset with.

    The fingers stay position controlled, so that a sideways push on the held object meets their stiffness.
    """

    config: "HoldGripperControllerConfig"

    def _initialize_action_space(self):
        nothing = np.empty(0, np.float32)
        self.single_action_space = spaces.Box(nothing, nothing, dtype=np.float32)

    def set_action(self, action):
        pass


@dataclass
class HoldGripperControllerConfig(PDJointPosControllerConfig):
    """Configuration of `HoldGripperController`."""

    normalize_action: bool = False
    controller_cls = HoldGripperController
