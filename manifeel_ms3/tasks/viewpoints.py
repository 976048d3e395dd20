"""Camera poses.

They are computed in double precision. ManiSkill's `sapien_utils.look_at` computes in single precision, which would change the
images by a few bits.
"""

import numpy as np
import sapien

DOWNWARD_ANGLE = np.deg2rad(30)
"""Angle of the front and side cameras' optical axes below the horizon, in rad."""
FAR_FRONT_CAMERA_AT, FAR_SIDE_CAMERA_AT = (0.80, 0.0, 0.15), (0.5, -0.4, 0.17)
"""Positions of the front and side cameras of the exploration tasks, in m, base frame: further away than in
the other tasks. The side camera's is that of the paper's public code."""


def looking_at(eye: np.ndarray, target: np.ndarray) -> sapien.Pose:
    """Pose of an upright camera at `eye` that looks at `target`, both (3,), in m (SAPIEN's axes: x ahead, y left, z up)."""
    ahead = (target - eye) / np.linalg.norm(target - eye)
    left = np.cross([0.0, 0.0, 1.0], ahead)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([ahead, left, np.cross(ahead, left)], axis=1)
    matrix[:3, 3] = eye
    return sapien.Pose(matrix)


def looking_down(position: tuple[float, float, float], heading: tuple[float, float]) -> sapien.Pose:
    """Pose of a camera that looks 30 degrees down.

    Args:
        position: Position of the camera, in m.
        heading: Horizontal direction (x, y) of its view, of length 1.
    """
    eye = np.array(position)
    return looking_at(eye, eye + np.array([*heading, -np.tan(DOWNWARD_ANGLE)]))
