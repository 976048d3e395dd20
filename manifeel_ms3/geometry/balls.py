"""Two balls that look alike and feel different, and the stand they sit on."""

import functools

import numpy as np
import trimesh

from manifeel_ms3.rendering.looks import DARK_PLASTIC, WHITE_PLASTIC

from .part import Ball, Box, Part, block_with_holes

BALL_RADIUS = 0.02075
"""Radius of both balls, in m: between a table-tennis ball's 20.0 mm (ITTF) and a golf ball's 21.35 mm (R&A, USGA)."""
GOLF_MASS, TENNIS_MASS = 0.0459, 0.0027
"""Masses of a golf ball (R&A, USGA) and of a table-tennis ball (ITTF), in kg."""
DIMPLES, DIMPLE_DEPTH, DIMPLE_RADIUS = 336, 2.5e-4, 1.75e-3
"""Number of a golf ball's dimples, and the depth and radius of each, in m: typical values."""
SEAT_SPACING, SEAT_HOLE, STAND_HEIGHT = 0.130, 0.020, 0.015
"""Distance of the seats, side of a seat's square hole, and height of the stand, in m; open fingers fit between the seats."""
SEAT_SIZE = (0.05, 0.05)
"""Size of a seat along x and y, in m. Chosen by eye."""
BAR_HEIGHT = STAND_HEIGHT / 3
"""Height of the bar that joins the seats, in m. Chosen by eye."""
SUBDIVISIONS = 6
"""Subdivisions of the golf ball's icosahedron: 82,000 triangles, of about 0.4 mm, resolve the dimples."""
SEAT_HEIGHT = STAND_HEIGHT + float(np.sqrt(BALL_RADIUS**2 - (SEAT_HOLE / 2) ** 2))
"""Height of a seated ball's centre, in m: the ball rests on the four edges of a square hole."""


@functools.cache
def golf_ball() -> Part:
    """Ball whose dimples the pads feel; for cameras and contacts it is a smooth sphere."""
    return _ball("golf_ball", GOLF_MASS, golf_ball_mesh())


def tennis_ball() -> Part:
    """Smooth table-tennis ball of the same size and colour as the golf ball."""
    return _ball("tennis_ball", TENNIS_MASS, None)


def _ball(name: str, mass: float, relief: trimesh.Trimesh | None) -> Part:
    volume = 4 / 3 * np.pi * BALL_RADIUS**3
    return Part(name, (Ball(BALL_RADIUS),), WHITE_PLASTIC, density=mass / volume, relief=relief)


def golf_ball_mesh() -> trimesh.Trimesh:
    """Golf ball of 82,000 triangles, in m: a sphere with 336 spherical dimples, evenly spread (Fibonacci lattice)."""
    mesh = trimesh.creation.icosphere(subdivisions=SUBDIVISIONS, radius=1.0)
    k = np.arange(DIMPLES) + 0.5
    polar, turn = np.arccos(1 - 2 * k / DIMPLES), np.pi * (1 + np.sqrt(5)) * k
    centres = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    # the direction's angle from the nearest dimple's middle, as a length on the ball
    distance = BALL_RADIUS * np.arccos((mesh.vertices @ centres.T).max(axis=1).clip(-1, 1))
    cup = (DIMPLE_RADIUS**2 + DIMPLE_DEPTH**2) / (2 * DIMPLE_DEPTH)
    depth = np.sqrt(np.maximum(cup**2 - distance**2, 0)) - (cup - DIMPLE_DEPTH)
    return trimesh.Trimesh(mesh.vertices * (BALL_RADIUS - depth.clip(min=0))[:, None], mesh.faces, process=False)


def ball_stand() -> Part:
    """Two seats with a square hole each, side by side along y, joined by a bar. Its frame is in the middle of the underside."""
    seat = block_with_holes(SEAT_SIZE, STAND_HEIGHT, [((SEAT_HOLE, SEAT_HOLE), (0.0, 0.0))])
    seats = [
        Box(box.size, (box.centre[0], box.centre[1] + side * SEAT_SPACING / 2, box.centre[2]))
        for side in (-1, 1)
        for box in seat
    ]
    bar = Box((SEAT_SIZE[0], SEAT_SPACING - SEAT_SIZE[1], BAR_HEIGHT), (0.0, 0.0, BAR_HEIGHT / 2))
    return Part("stand", (*seats, bar), DARK_PLASTIC)
