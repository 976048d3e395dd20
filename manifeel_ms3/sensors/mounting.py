"""Helpers for a pad on a link of any robot: its pose, from two directions, and grids that cover a gel of any size."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien

from manifeel_ms3.errors import InvalidArgumentError

from .config import TactileSensorConfig

CELL_ROUNDING = 1e-6
"""Share of a pixel or taxel by which a gel may seem too small, through rounding, and still hold it."""
SMALLEST_SINE = 0.5
"""Smallest sine of the angle between two directions that define a pose: 30 degrees (chosen)."""


def pad_pose(facing: Sequence[float], tip: Sequence[float], at: Sequence[float]) -> sapien.Pose:
    """Pose of a pad in the frame of its link, for `TactileSensorConfig.pad_pose`.

    Args:
        facing: Direction, in the link's frame, in which the gel's face looks, towards what it touches.
        tip: Direction towards the finger's tip, in the link's frame; its component along `facing` is ignored.
        at: Centre of the untouched face, in the link's frame, in m.

    Raises:
        InvalidArgumentError: The two directions are nearly parallel, or one has no length.
    """
    out, up = np.asarray(facing, float), np.asarray(tip, float)
    lengths = np.linalg.norm(out) * np.linalg.norm(up)
    if lengths == 0 or np.linalg.norm(np.cross(out, up)) < SMALLEST_SINE * lengths:
        raise InvalidArgumentError(f"facing={tuple(facing)} and tip={tuple(tip)} must be directions at an angle to each other")
    z = out / np.linalg.norm(out)
    y = up - (up @ z) * z
    y /= np.linalg.norm(y)
    matrix = np.eye(4)
    matrix[:3] = np.stack([np.cross(y, z), y, z, np.asarray(at, float)], axis=1)
    return sapien.Pose(matrix)


def grids_for(size: Sequence[float], sensor: TactileSensorConfig | None = None) -> dict[str, Any]:
    """`image_shape` and `taxel_shape` of a `TactileSensorConfig` that cover a gel, at the pixels and taxels of a sensor.

        TactileSensorConfig("touch", "finger", pose, GelConfig(size=(0.016, 0.020)), **grids_for((0.016, 0.020)))

    Args:
        size: Extent of the gel across and along the finger, in m.
        sensor: Sensor whose pixels and taxels are taken; the R1.5 if not given.

    Raises:
        InvalidArgumentError: The gel is smaller than one taxel.
    """
    cells = TactileSensorConfig if sensor is None else sensor
    pitches = dict(image_shape=cells.pixel_size, taxel_shape=cells.taxel_pitch)
    shapes = {name: tuple(int(extent / pitch + CELL_ROUNDING) for extent in size) for name, pitch in pitches.items()}
    if min(shapes["taxel_shape"]) < 1:
        raise InvalidArgumentError(f"a gel of {tuple(size)} m is smaller than a taxel, {pitches['taxel_shape']} m; give metres")
    return shapes
