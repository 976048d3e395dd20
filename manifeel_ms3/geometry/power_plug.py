"""A NEMA 5-15 plug with two blades and a longer ground pin that finds its hole first, and the socket with three holes."""

from dataclasses import dataclass

import numpy as np

from manifeel_ms3.arguments import one_of
from manifeel_ms3.rendering import looks

from . import materials
from .fits import UNSEATED_SHARE, Fit, MeetingFaces
from .part import Box, Cylinder, Holes, Hulls, Part, Piece, bevelled_box, block_with_chamfered_holes, lofted

ARC_POINTS = 8
"""Number of points of the round side of the U-shaped ground pin. Set once; not tuned."""


@dataclass(frozen=True)
class PowerPlugSizes:
    """Sizes of plug and socket, in m. The blades are wide along x and thin along y; the ground pin lies at positive x."""

    blade: tuple[float, float, float]
    """Width, thickness and length of each blade."""
    blade_tip: float
    """Length over which a blade narrows to `TIP_SHARE` of its section; 0 for a blunt blade."""
    spacing: float
    """Distance of the blades' middles, along y."""
    offset: float
    """Distance of the ground pin from the line between the blades, along x."""
    ground: tuple[float, float, float]
    """Size of the ground pin along x and y, and its length."""
    ground_tip: tuple[float, float]
    """Size of the ground pin's end along y, and the length over which the pin narrows to it; 0 for a blunt pin."""
    blade_hole: tuple[float, float]
    """Size of each blade's hole along x and y."""
    ground_hole: tuple[float, float]
    """Size of the ground pin's hole along x and y."""
    depth: float
    """Depth of the holes."""
    chamfer: float
    """Width of the chamfer around the holes' mouths."""
    block: tuple[float, float, float]
    """Size of the socket's block."""
    handle: tuple[float, float, float]
    """Size of the handle, which the fingers hold."""
    head: tuple[float, float, float] | None = None
    """Size of the broad body from which the prongs come, at the handle's end and within its length; None if there is none."""


TIP_SHARE = 0.6
"""Share of a blade's section that is left at its tip. Chosen by eye."""
SIZES = {
    # 1.8 times NEMA 5-15, measured in the meshes of the public code
    "paper": PowerPlugSizes(
        blade=(0.01161, 0.00256, 0.0250),
        blade_tip=0.0045,
        spacing=0.0225,
        offset=1.8 * 0.0119,
        ground=(0.00873, 0.00848, 0.0340),
        ground_tip=(0.0068, 0.0050),
        blade_hole=(0.0126, 0.0036),
        ground_hole=(0.01042, 0.00972),
        depth=0.032,
        chamfer=2e-4,
        block=(0.054, 0.090, 0.045),
        handle=(0.019, 0.045, 0.060),
        head=(0.056, 0.045, 0.014),
    ),
    # NEMA 5-15 (ANSI/NEMA WD 6) with 0.2 mm of play on each side
    "tight": PowerPlugSizes(
        blade=(0.00635, 0.0015, 0.0175),
        blade_tip=0.0,
        spacing=0.0127,
        offset=0.0119,
        ground=(0.0048, 0.0048, 0.0206),
        ground_tip=(0.0048, 0.0),
        blade_hole=(0.00675, 0.0019),
        ground_hole=(0.0052, 0.0052),
        depth=0.0206,
        chamfer=0.0,
        block=(0.060, 0.060, 0.030),
        handle=(0.019, 0.032, 0.055),
    ),
}
"""Sizes by the name of the fit."""
GRIP = -0.006
"""Distance of the middle between the pads from the handle's middle along the plug's z, in m. Set once; not tuned."""


def power_fit(fit: str = "paper") -> Fit:
    """NEMA 5-15 plug on a handle and a socket that looks up.

    Args:
        fit: "paper" for 1.8 times the standard's size with 0.5 to 0.8 mm of play on each side; "tight" for the standard's size.
    """
    sizes = SIZES[one_of("fit", fit, SIZES)]
    half = sizes.handle[2] / 2
    head = [Box(sizes.head, (0.0, 0.0, half - sizes.head[2] / 2))] if sizes.head else []
    rim, floor = sizes.block[2], sizes.block[2] - sizes.depth
    ground, hole = sizes.ground, sizes.ground_hole
    return Fit(
        plug=Part(
            "power_plug",
            (_ground_pin(sizes, half), *_blades(sizes, half), Box(sizes.handle), *head),
            looks.DARK_PLASTIC,
            other_looks={0: looks.BRASS, 1: looks.STEEL, 2: looks.STEEL},
            other_densities=dict.fromkeys(range(3), materials.BRASS),
        ),
        socket=Part("power_socket", (Box((*sizes.block[:2], floor), (0, 0, floor / 2)), *_outlet(sizes)), looks.WHITE_PLASTIC),
        reach=half + ground[2],
        grip=GRIP,
        grip_width=sizes.handle[1],
        rim=rim,
        floor=floor,
        max_gap=UNSEATED_SHARE * sizes.blade[2],
        goes_in_upright=fit == "paper",
        pin=(ground[0] / 2, ground[1] / 2),
        hole=(hole[0] / 2, hole[1] / 2),
        hole_at=(sizes.offset / 2, 0.0),
        meeting_faces=(MeetingFaces(middle=(sizes.offset / 2, 0.0)),),
    )


def _blades(sizes: PowerPlugSizes, bottom: float) -> list[Piece]:
    x, y, long = sizes.blade
    places = [(-sizes.offset / 2, side * sizes.spacing / 2) for side in (-1, 1)]
    if not sizes.blade_tip:
        return [Box(sizes.blade, (*place, bottom + long / 2)) for place in places]
    rectangle = np.array([(sx * x / 2, sy * y / 2) for sx in (-1, 1) for sy in (-1, 1)])
    levels = [(rectangle, 0.0), (rectangle, long - sizes.blade_tip), (TIP_SHARE * rectangle, long)]
    return [_prong(levels, place, bottom) for place in places]


def _ground_pin(sizes: PowerPlugSizes, bottom: float) -> Piece:
    x, y, long = sizes.ground
    tip, taper = sizes.ground_tip
    place = (sizes.offset / 2, 0.0)
    if not taper:
        return Cylinder(x / 2, long, (*place, bottom + long / 2))
    # a U: half round towards +x, straight behind
    angles = np.linspace(-np.pi / 2, np.pi / 2, ARC_POINTS)
    arc = np.c_[x / 2 - y / 2 + y / 2 * np.cos(angles), y / 2 * np.sin(angles)]
    section = np.concatenate([arc, [(-x / 2, -y / 2), (-x / 2, y / 2)]])
    return _prong([(section, 0.0), (section, long - taper), (tip / y * section, long)], place, bottom)


def _prong(levels: list[tuple[np.ndarray, float]], place: tuple[float, float], bottom: float) -> Hulls:
    """Convex prong through sections (n, 2) at heights over `bottom`."""
    return Hulls((lofted([(section + place, bottom + z) for section, z in levels]),))


def _outlet(sizes: PowerPlugSizes) -> tuple[Piece, ...]:
    """Slab with the ground hole and two blade holes, which are one wide hole with a bar in its middle."""
    (x, y), rim = sizes.blade_hole, sizes.block[2]
    at, middle = -sizes.offset / 2, rim - sizes.depth / 2
    holes: Holes = [((x, sizes.spacing + y), (at, 0.0)), (sizes.ground_hole, (sizes.offset / 2, 0.0))]
    bar = Box((x + 2 * sizes.chamfer, sizes.spacing - y, sizes.depth), (at, 0.0, middle))
    slab = block_with_chamfered_holes(sizes.block[:2], sizes.depth, holes, rim - sizes.depth, sizes.chamfer)
    return (*slab, bevelled_box(bar, sizes.chamfer, ("-y", "+y")))
