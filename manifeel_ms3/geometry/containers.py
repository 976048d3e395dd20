"""The containers of the exploration tasks, and the battery that is hidden in one."""

from typing import cast

import numpy as np
import trimesh

from manifeel_ms3.rendering.looks import BRASS, CARDBOARD, Look

from .part import Box, Cylinder, Hulls, Part, ring_of_wedges

CONTAINER_OUTER, CONTAINER_HEIGHT, CONTAINER_WALL = (0.322, 0.281), 0.161, 0.004
"""Outer size of the container along x and y, its height, and the thickness of its walls, in m. Set once; not tuned."""
CONTAINER_FLOOR = 0.004
"""Thickness of the container's floor, in m. Set once; not tuned."""
BATTERY_SIZE = 0.025
"""Side of the cube-shaped battery, in m. Set once; not tuned."""
TERMINAL_SIZE, TERMINAL_HEIGHT = BATTERY_SIZE / 3, 0.001
"""Side and height of the battery's contact, in m. Chosen by eye."""
BATTERY_LOOK = Look((0.05, 0.25, 0.10))
"""Look of the battery: green, chosen by eye."""
BATTERY_DENSITY = 2000.0
"""Density of the battery, in kg/m^3: an alkaline block 6LR61 has 45 g in 48.5 x 26.5 x 17.5 mm (data sheets)."""
BOWL_RADIUS, BOWL_HEIGHT, BOWL_FLOOR = 0.045, 0.035, 0.010
"""Inner radius and height of a bowl, and the thickness of its floor, in m. Chosen by eye."""
BOWL_WALL, BOWL_WEDGES = 0.005, 16
"""Thickness of a bowl's round wall, in m, and number of its convex pieces. Chosen by eye."""


def container(front_drawn: bool) -> Part:
    """Opaque container in which the battery lies.

    Args:
        front_drawn: Whether the front, at +x, is drawn and touched; it collides in any case.
    """
    return open_box(CONTAINER_OUTER, CONTAINER_HEIGHT, front_drawn)


def open_box(outer: tuple[float, float], height: float, front_drawn: bool) -> Part:
    """Opaque box, open above. Its frame is in the middle of its underside.

    Args:
        outer: Outer size along x and y, in m.
        height: Height, in m.
        front_drawn: Whether the front, at +x, is drawn and touched; it collides in any case.
    """
    (x, y), wall = outer, CONTAINER_WALL
    pieces = (
        Box((wall, y, height), ((x - wall) / 2, 0.0, height / 2)),
        Box((wall, y, height), (-(x - wall) / 2, 0.0, height / 2)),
        *(Box((x - 2 * wall, wall, height), (0.0, side * (y - wall) / 2, height / 2)) for side in (-1, 1)),
        Box((x - 2 * wall, y - 2 * wall, CONTAINER_FLOOR), (0.0, 0.0, CONTAINER_FLOOR / 2)),
    )
    if front_drawn:
        return Part("container", pieces, CARDBOARD)
    others = cast(trimesh.Trimesh, trimesh.util.concatenate([piece.mesh for piece in pieces[1:]]))
    return Part("container", pieces, CARDBOARD, undrawn=frozenset({0}), relief=others)


def battery() -> Part:
    """Cube-shaped battery block with its contact in the middle of one face."""
    size = BATTERY_SIZE
    terminal = Box((TERMINAL_SIZE, TERMINAL_SIZE, TERMINAL_HEIGHT), (0.0, 0.0, size / 2 + TERMINAL_HEIGHT / 2))
    return Part(
        "battery",
        (Box((size, size, size)), terminal),
        BATTERY_LOOK,
        density=BATTERY_DENSITY,
        other_looks={1: BRASS},
    )


def bowl(name: str, look: Look) -> Part:
    """Round bowl with an upright wall. Its frame is in the middle of its underside."""

    def rim(angles: np.ndarray) -> np.ndarray:
        return np.full_like(angles, BOWL_RADIUS + BOWL_WALL)

    wall = ring_of_wedges(BOWL_WEDGES, BOWL_RADIUS, rim, 0.0, BOWL_HEIGHT)
    floor = Cylinder(BOWL_RADIUS, BOWL_FLOOR, (0.0, 0.0, BOWL_FLOOR / 2))
    return Part(name, (Hulls(tuple(wall)), floor), look)
