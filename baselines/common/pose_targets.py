"""Actions as targets: the pose that the hand is to have at each step of a prediction, instead of how far it moves.

The position of a target is relative to the tool's at the last observation, in m. Its orientation is the rotation from a hand
that points down, as a rotation vector in rad. Both are along the axes of the robot's base. A hand that is to be upright thus
has the same orientation as its target wherever it is, and the sum of many small predicted motions need not be exact. Diffusion
Policy (Chi et al. 2023) learns positions better than velocities, and UMI (Chi et al. 2024) predicts poses relative to the
present one. docs/trials.md has the trials.

The environment's actions stay motions. A `Command` follows the controller's own target, and so turns one into the other.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from manifeel_ms3.agents.controllers import LimitedLeadEEPoseControllerConfig as Controller
from manifeel_ms3.agents.panda_gelsight import ACTION_AXES, LOCKED_AXES

from .observation import MIDDLE_QUATERNION, POSE_FEATURES

POSITION, ROTATION = slice(0, 3), slice(3, 6)
"""Components of an action or target that move, and that turn, the hand; the others, such as the gripper's, stay as they are."""
CONTROL_MODES = tuple(mode for mode, axes in ACTION_AXES.items() if axes[:6] == ("x", "y", "z", "roll", "pitch", "yaw"))
"""Control modes whose actions can be turned into targets."""
POINTING_DOWN = Rotation.from_quat(MIDDLE_QUATERNION, scalar_first=True)
"""Orientation of a hand that points down."""


def rotations_of(poses: np.ndarray) -> Rotation:
    """The orientations of poses (T, 7) or (T, 9) in the form in which policies take them."""
    if poses.shape[1] == POSE_FEATURES["quaternion"]:
        return Rotation.from_quat(poses[:, 3:], scalar_first=True)
    first, second = poses[:, 3:6], poses[:, 6:9]
    return Rotation.from_matrix(np.stack([first, second, np.cross(first, second)], axis=2))


class Command:
    """The pose that the controller has been commanded to reach, as `LimitedLeadEEPoseController` computes it.

    Args:
        position: Position (3,) of the tool at the start of the episode, in m; the controller's own target may be some tenths of
            a millimetre beside it there.
        rotation: Orientation of the tool there.
        control_mode: Control mode of the actions, one of `CONTROL_MODES`.
    """

    def __init__(self, position: np.ndarray, rotation: Rotation, control_mode: str):
        self._position, self._rotation = position, rotation
        self._locked = list(LOCKED_AXES.get(control_mode, ()))

    def follow(self, position: np.ndarray, rotation: Rotation) -> None:
        """Limit the lead of the command over the tool, before an action is added.

        Args:
            position: Position (3,) of the tool, in m.
            rotation: Orientation of the tool.
        """
        lead, turn = self._position - position, (self._rotation * rotation.inv()).as_rotvec()
        self._position = position + lead * _shortening(lead, Controller.target_lead_limit_pos)
        self._rotation = Rotation.from_rotvec(turn * _shortening(turn, Controller.target_lead_limit_rot)) * rotation

    def move(self, action: np.ndarray) -> None:
        """Add an action (A,), whose components the controller limits to [-1, 1]."""
        motion = np.clip(action, -1.0, 1.0)
        turn = Controller.rot_upper * motion[ROTATION]
        turn[self._locked] = 0.0
        self._position = self._position + Controller.pos_upper * motion[POSITION]
        self._rotation = Rotation.from_rotvec(turn) * self._rotation

    def as_target(self) -> np.ndarray:
        """The command as a target (6,), with its position in the base frame."""
        return np.concatenate([self._position, (self._rotation * POINTING_DOWN.inv()).as_rotvec()])

    def action_to(self, target: np.ndarray) -> np.ndarray:
        """The action (A,), within [-1, 1], that brings the command to a target (A,) as far as one step can.

        Args:
            target: Position (3,) in the base frame, orientation (3,), and further components, which stay as they are.
        """
        turn = (Rotation.from_rotvec(target[ROTATION]) * POINTING_DOWN * self._rotation.inv()).as_rotvec()
        motion = (target[POSITION] - self._position) / Controller.pos_upper
        return np.concatenate([motion, turn / Controller.rot_upper, target[6:]]).clip(-1.0, 1.0).astype(np.float32)


def _shortening(vector: np.ndarray, limit: float) -> float:
    """Factor that shortens a vector to a length."""
    return limit / max(float(np.linalg.norm(vector)), limit)


def as_targets(poses: np.ndarray, actions: np.ndarray, control_mode: str) -> np.ndarray:
    """Targets (T, A) of an episode's actions, with their positions in the base frame.

    Args:
        poses: Poses of the tool (T + 1, 7) or (T + 1, 9), in the form in which policies take them.
        actions: Actions (T, A).
        control_mode: Control mode of the actions, one of `CONTROL_MODES`.
    """
    positions, rotations, targets = poses[:, POSITION].astype(float), rotations_of(poses), actions.astype(np.float32)
    command = Command(positions[0], rotations[0], control_mode)
    for step in range(len(actions)):
        command.follow(positions[step], rotations[step])
        command.move(actions[step])
        targets[step, :6] = command.as_target()
    return targets
