"""Camera poses.

ManiSkill's `sapien_utils.look_at` computes in single precision; these poses are computed in double precision, and images
recorded with them would change by a few bits with ManiSkill's.
"""

import numpy as np
import sapien

DOWNWARD_ANGLE = np.deg2rad(30)
"""Angle of the front and side cameras' optical axes below the horizon."""


def looking_at(eye: np.ndarray, target: np.ndarray) -> sapien.Pose:
    """Camera pose at `eye` that looks at `target`, upright (SAPIEN's camera axes: x ahead, y left, z up)."""
    ahead = (target - eye) / np.linalg.norm(target - eye)
    left = np.cross([0.0, 0.0, 1.0], ahead)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([ahead, left, np.cross(ahead, left)], axis=1)
    matrix[:3, 3] = eye
    return sapien.Pose(matrix)


def looking_down(position: tuple[float, float, float], heading: tuple[float, float]) -> sapien.Pose:
    """Camera pose that looks along `heading` and 30 degrees down."""
    eye = np.array(position)
    return looking_at(eye, eye + np.array([*heading, -np.tan(DOWNWARD_ANGLE)]))
