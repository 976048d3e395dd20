"""Random starts of the tool."""

import torch
from mani_skill.utils.geometry.rotation_conversions import axis_angle_to_quaternion, quaternion_multiply
from mani_skill.utils.structs import Pose

# a tool that points down reaches 0.30 to 0.72 m from the base's axis, up to 0.35 m high (by inverse kinematics, to 0.1 mm)
REACH_XY = 0.19  # m, each axis, around (0.5, 0)
HIGHEST = 0.35  # m
OUT_OF_REACH = "further out it is out of the robot's reach"


def start_pose(n: int, position: tuple[float, float, float], ranges: tuple[float, float, float], rotation: float) -> Pose:
    """Random tool poses (n,) that point down: `position` +- `ranges`, m, turned by +- `rotation`, rad, about each base axis."""
    offset = (2 * torch.rand(n, 3) - 1) * torch.tensor(ranges)
    return Pose.create_from_pq(torch.tensor(position) + offset, random_downward(n, rotation))


def random_downward(n: int, rotation: float) -> torch.Tensor:
    """Quaternions (n, 4) of a tool that points down with its x along the base's, turned by +- `rotation` about each axis."""
    turn = axis_angle_to_quaternion((2 * torch.rand(n, 3) - 1) * rotation)
    return quaternion_multiply(turn, torch.tensor([0.0, 1.0, 0.0, 0.0]).expand(n, 4))


def height_range(start: float, lowest: float) -> float:
    """Largest half range, m, of a start height that stays above `lowest` and within reach."""
    return min(start - lowest, HIGHEST - start)
