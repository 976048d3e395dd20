"""Pegs and plugs with their sockets: the 12 mm peg of the paper's public code, USB-A, NEMA 5-15."""

from . import materials
from .fits import Fit
from .part import Box, Cylinder, Part, block_with_holes

METAL, BRASS, PLASTIC, DARK = (0.72, 0.74, 0.78), (0.80, 0.62, 0.20), (0.25, 0.35, 0.55), (0.14, 0.14, 0.16)

PEG_SIZE = (0.01196, 0.00791, 0.050)  # m
PEG_HOLES = {
    "tight": (0.012, 0.008),  # 0.04 and 0.09 mm wider than the peg
    "loose": (0.01246, 0.00841),  # 0.5 mm wider
}


def peg_fit(fit: str) -> Fit:
    """Rectangular peg, 50 mm long, and a socket 9 mm deep; the table is the hole's floor."""
    hole = PEG_HOLES[fit]
    return Fit(
        plug=Part("peg", (Box(PEG_SIZE),), colour=BRASS, density=materials.BRASS),
        socket=Part("socket", block_with_holes((0.025, 0.025), 0.009, [(hole, (0.0, 0.0))]), colour=PLASTIC),
        reach=PEG_SIZE[2] / 2,
        grip=-0.014,
        grip_width=PEG_SIZE[1],
        rim=0.009,
        floor=0.0,
        **Fit.into_hole((PEG_SIZE[0] / 2, PEG_SIZE[1] / 2), (hole[0] / 2, hole[1] / 2)),
    )


REORIENTATION_PEG = (0.016, 0.010, 0.050)  # m
REORIENTATION_GAP, RIM_DEPTH, RIM_BOTTOM = 2e-4, 0.015, 0.005  # m


def reorientation_fit() -> Fit:
    """Peg 16 x 10 x 50 mm and a rim 15 mm deep around its place, 0.2 mm wider on each side."""
    x, y, z = REORIENTATION_PEG
    hole = (x + 2 * REORIENTATION_GAP, y + 2 * REORIENTATION_GAP)
    base = Box((0.03, 0.03, RIM_BOTTOM), (0.0, 0.0, RIM_BOTTOM / 2))
    rim = block_with_holes((0.03, 0.03), RIM_DEPTH, [(hole, (0.0, 0.0))], bottom=RIM_BOTTOM)
    return Fit(
        plug=Part("peg", (Box(REORIENTATION_PEG),), colour=BRASS, density=materials.BRASS),
        socket=Part("rim", (base, *rim), colour=PLASTIC),
        reach=z / 2,
        grip=-0.018,  # the fingers stay clear of the rim at 30 degrees
        grip_width=y,
        rim=RIM_BOTTOM + RIM_DEPTH,
        floor=RIM_BOTTOM,
        **Fit.into_hole((x / 2, y / 2), (hole[0] / 2, hole[1] / 2)),
    )


USB_SHELL = (0.0120, 0.0045, 0.0120)  # m: USB-A plug (USB 2.0, 6.7)
USB_WALL = 0.0003
USB_TONGUE = 0.0020  # thickness of the plug's insulator, on the -y side, and of the port's, on the +y side
USB_RECESS = 0.0030  # m from the port's mouth to its tongue
USB_GAP = 1e-4  # m, on each side


def usb_fit() -> Fit:
    """USB-A plug on a handle 12 x 30 x 70 mm, and a port in a block 66 x 66 x 37 mm. It goes in one way round alone.

    The handle is narrower than a pad, so that touch sees its edges.
    """
    x, y, z = USB_SHELL
    handle = 0.070
    middle = handle / 2 + z / 2
    shell = [
        Box((x, USB_WALL + USB_TONGUE, z), (0.0, -y / 2 + (USB_WALL + USB_TONGUE) / 2, middle)),
        Box((x, USB_WALL, z), (0.0, y / 2 - USB_WALL / 2, middle)),
        *(Box((USB_WALL, y, z), (side * (x - USB_WALL) / 2, 0.0, middle)) for side in (-1, 1)),
    ]
    hole = (x + 2 * USB_GAP, y + 2 * USB_GAP)
    rim, floor = 0.037, 0.037 - z
    tongue_y = (-y / 2 + USB_WALL + USB_TONGUE + USB_GAP, y / 2 - USB_WALL - USB_GAP)  # between the plug's insulator and shell
    tongue = Box(
        (x - 2 * USB_WALL - 2 * USB_GAP, tongue_y[1] - tongue_y[0], z - USB_RECESS),
        (0.0, sum(tongue_y) / 2, floor + (z - USB_RECESS) / 2),
    )
    walls = block_with_holes((0.066, 0.066), z, [(hole, (0.0, 0.0))], bottom=floor)
    base = Box((0.066, 0.066, floor), (0.0, 0.0, floor / 2))
    # the tongue stands mirrored in y: a plug that points down has its y turned over
    tongue = Box(tongue.size, (0.0, -tongue.centre[1], tongue.centre[2]))
    return Fit(
        plug=Part(
            "usb_plug",
            (Box((0.012, 0.030, handle)), *shell),
            DARK,
            other_colours=dict.fromkeys(range(1, 5), METAL),
            other_densities=dict.fromkeys(range(1, 5), materials.STEEL),
        ),
        socket=Part("usb_port", (base, *walls, tongue), PLASTIC, other_colours={5: (0.9, 0.9, 0.9)}),
        reach=handle / 2 + z,
        grip=-0.012,
        grip_width=0.030,
        rim=rim,
        floor=floor,
        **Fit.into_hole((x / 2, y / 2), (hole[0] / 2, hole[1] / 2)),
    )


BLADE = (0.00635, 0.0015, 0.0175)  # m: NEMA 5-15 (ANSI/NEMA WD 6); here the blades' width lies along x
BLADE_SPACING = 0.0127
GROUND_RADIUS, GROUND_LENGTH, GROUND_OFFSET = 0.0024, 0.0206, 0.0119
NEMA_GAP = 2e-4  # m, on each side


def power_fit() -> Fit:
    """NEMA 5-15 plug: two blades, and a longer round ground pin that finds its hole first; socket with three holes."""
    handle = 0.055
    blades = [Box(BLADE, (-GROUND_OFFSET / 2, side * BLADE_SPACING / 2, handle / 2 + BLADE[2] / 2)) for side in (-1, 1)]
    ground = Cylinder(GROUND_RADIUS, GROUND_LENGTH, (GROUND_OFFSET / 2, 0.0, handle / 2 + GROUND_LENGTH / 2))
    rim, floor = 0.030, 0.030 - GROUND_LENGTH
    blade_hole, ground_hole = (BLADE[0] + 2 * NEMA_GAP, BLADE[1] + 2 * NEMA_GAP), 2 * (GROUND_RADIUS + NEMA_GAP)
    return Fit(
        plug=Part(
            "power_plug",
            (Box((0.019, 0.032, handle)), *blades, ground),
            DARK,
            other_colours={1: METAL, 2: METAL, 3: BRASS},
            other_densities=dict.fromkeys((1, 2, 3), materials.BRASS),
        ),
        socket=Part(
            "power_socket",
            (Box((0.06, 0.06, floor), (0, 0, floor / 2)), *_outlet(rim, floor, blade_hole, ground_hole)),
            (0.85, 0.85, 0.82),
        ),
        reach=handle / 2 + GROUND_LENGTH,
        grip=-0.006,
        grip_width=0.032,
        rim=rim,
        floor=floor,
        **Fit.into_hole((GROUND_RADIUS, GROUND_RADIUS), (ground_hole / 2, ground_hole / 2), (GROUND_OFFSET / 2, 0.0)),
    )


def _outlet(rim: float, floor: float, blade_hole: tuple[float, float], ground_hole: float) -> tuple[Box, ...]:
    """Slab with the ground hole and, at one x, two blade holes: three bars beside the holes of a slab with one wide hole."""
    wide = BLADE_SPACING + blade_hole[1]
    slab = block_with_holes(
        (0.06, 0.06),
        rim - floor,
        [((blade_hole[0], wide), (-GROUND_OFFSET / 2, 0.0)), ((ground_hole, ground_hole), (GROUND_OFFSET / 2, 0.0))],
        bottom=floor,
    )
    bar = Box((blade_hole[0], BLADE_SPACING - blade_hole[1], rim - floor), (-GROUND_OFFSET / 2, 0.0, (rim + floor) / 2))
    return (*slab, bar)
