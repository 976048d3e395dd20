"""Camera poses."""

import numpy as np
import sapien


def looking_at(eye: np.ndarray, target: np.ndarray) -> sapien.Pose:
    """Camera pose at `eye` that looks at `target`, upright (SAPIEN: x ahead, y left, z up)."""
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
    return looking_at(eye, eye + np.array([*heading, -np.tan(np.deg2rad(30))]))
