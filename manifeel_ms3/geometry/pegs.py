"""Rectangular peg and socket, after the 12 mm peg of the paper's public code."""

from .part import Box, Part

PEG_SIZE = (0.01196, 0.00791, 0.050)  # m
SOCKET_OUTER = (0.025, 0.025)
SOCKET_DEPTH = 0.009
HOLES = {
    "tight": (0.012, 0.008),  # 0.04 and 0.09 mm wider than the peg
    "loose": (0.01246, 0.00841),  # 0.5 mm wider
}


def rectangular_peg() -> Part:
    """Peg in its centre's frame, z along it."""
    return Part("peg", (Box(PEG_SIZE),), colour=(0.80, 0.62, 0.20), density=2700.0)  # aluminium


def rectangular_socket(fit: str) -> Part:
    """Block with a through hole of `fit`; its frame lies in the middle of the bottom, z up. The table is the hole's floor."""
    (x, y), (hole_x, hole_y) = SOCKET_OUTER, HOLES[fit]
    wall_x, wall_y = (x - hole_x) / 2, (y - hole_y) / 2
    up = SOCKET_DEPTH / 2
    walls = [Box((wall_x, y, SOCKET_DEPTH), (side * (hole_x + wall_x) / 2, 0.0, up)) for side in (-1.0, 1.0)] + [
        Box((hole_x, wall_y, SOCKET_DEPTH), (0.0, side * (hole_y + wall_y) / 2, up)) for side in (-1.0, 1.0)
    ]
    return Part("socket", tuple(walls), colour=(0.25, 0.35, 0.55))
