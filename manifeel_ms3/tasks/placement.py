"""Random poses at the start of an episode."""

import torch
from mani_skill.utils.geometry.rotation_conversions import axis_angle_to_quaternion, quaternion_multiply
from mani_skill.utils.structs import Pose

# A tool that points down reaches 0.30 to 0.72 m from the base's axis, up to 0.35 m high (found by inverse kinematics, to
# 0.1 mm).
WORKSPACE_XY = (0.5, 0.0)
"""Middle of the workspace on the table, in m, base frame: the nominal position of the fixed parts."""
REACH_XY = 0.19
"""Half range, in m, on each axis around `WORKSPACE_XY` that is within the robot's reach."""
HIGHEST = 0.35
"""Largest height of the tool, in m, that is within the robot's reach."""
BUILT_AT = (0.5, 0.0, 0.3)
"""Position at which the held parts are built, in m, clear of all others; every reset moves them into the hand."""
POINTING_DOWN = (0.0, 1.0, 0.0, 0.0)
"""Quaternion, w first, of a tool or a held part that points straight down: half a turn about x."""
OUT_OF_REACH = "further out it is out of the robot's reach"
"""What happens beyond `REACH_XY`, for messages."""


def uniform_in(half_range: float | torch.Tensor, *shape: int) -> torch.Tensor:
    """Uniform random numbers of a shape in [-half_range, half_range].

    ManiSkill's `randomization.uniform` rounds differently, and would change the episodes that belong to the seeds.

    Args:
        half_range: Half range; a tensor must broadcast to the shape.
        shape: Shape of the result.
    """
    return (2 * torch.rand(shape) - 1) * half_range


def turned_about(axis: int, angle: torch.Tensor) -> torch.Tensor:
    """Quaternions (n, 4), w first, of rotations by angles (n,), in rad, about the axis x (0), y (1) or z (2)."""
    turn = torch.zeros(len(angle), 3)
    turn[:, axis] = angle
    return axis_angle_to_quaternion(turn)


def start_pose(
    n: int, position: tuple[float, float, float], ranges: tuple[float, float, float], rotation: float | torch.Tensor
) -> Pose:
    """Random poses (n,) of a tool that points down.

    Args:
        n: Number of poses.
        position: Nominal position in the base frame, in m.
        ranges: Half range of each coordinate, in m.
        rotation: Half range of the rotation about every axis of the base frame, or about each (3,), in rad.
    """
    offset = uniform_in(torch.tensor(ranges), n, 3)
    return Pose.create_from_pq(torch.tensor(position) + offset, random_downward(n, rotation))


def random_downward(n: int, rotation: float | torch.Tensor) -> torch.Tensor:
    """Quaternions (n, 4), w first, of a tool that points down, its x along the base's, then turns by random angles.

    Args:
        n: Number of quaternions.
        rotation: Half range of the angle about every axis of the base frame, or about each (3,), in rad.
    """
    turn = axis_angle_to_quaternion(uniform_in(rotation, n, 3))
    return quaternion_multiply(turn, torch.tensor(POINTING_DOWN).expand(n, 4))


def height_range(start: float, lowest: float) -> float:
    """Largest half range, in m, of a start height that stays above `lowest` and within reach."""
    return min(start - lowest, HIGHEST - start)
