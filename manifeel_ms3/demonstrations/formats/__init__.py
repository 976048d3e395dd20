"""Formats in which demonstrations are stored: ManiSkill's trajectories, LeRobot's datasets, Diffusion Policy's zarr stores."""

from pathlib import Path

from .demonstration_format import Demonstration as Demonstration
from .demonstration_format import DemonstrationFormat as DemonstrationFormat
from .diffusion_policy_zarr import DIFFUSION_POLICY_ZARR
from .lerobot import LEROBOT
from .maniskill_h5 import MANISKILL_H5, DemonstrationError

FORMATS = (LEROBOT, DIFFUSION_POLICY_ZARR, MANISKILL_H5)
"""All formats that can be read."""


def format_of(path: Path) -> DemonstrationFormat:
    """The format of a file or folder of demonstrations.

    Raises:
        DemonstrationError: It is a folder of no known format.
    """
    for known in FORMATS:
        if known.matches(path):
            return known
    raise DemonstrationError(
        f"{path} is a folder, but no LeRobot dataset or zarr store; give one, or a trajectory file, which ends in .h5"
    )
