"""Spur gears that mesh, with involute teeth on a ring of convex wedges, and the base with the shafts on which they turn."""

import functools
from dataclasses import dataclass

import numpy as np

from manifeel_ms3.arguments import one_of
from manifeel_ms3.rendering.looks import BLUE_PLASTIC, DARK_PLASTIC, STEEL, Look

from .fits import Fit, MeetingFaces
from .materials import ABS, ALUMINIUM
from .part import Box, Cylinder, Hulls, Part, Piece, extruded, lofted, ring_of_wedges

MODULE = 0.002
"""Pitch diameter per tooth, in m (measured in the meshes of the public code)."""
PRESSURE_ANGLE = np.deg2rad(20.0)
"""Pressure angle of the teeth, in rad (ISO 53)."""
BACKLASH = 4e-4
"""Length on the pitch circle, in m, by which each gear's teeth are thinner than half the pitch. Set once; not tuned."""
TEETH = {"small": 9, "medium": 19, "large": 29}
"""Numbers of teeth; the gears are 22, 42 and 62 mm across, as in the public code."""
THICKNESS = {"small": 0.014, "medium": 0.020, "large": 0.014}
"""Thickness of the gears, in m. Set once; not tuned."""
SHAFT_HEIGHT = 0.018
"""Height of the shafts over the base, in m. Set once; not tuned."""
RING_HEIGHT = 0.005
"""Height of the ring between the medium gear and its handle, in m. Chosen by eye."""
BASE_SIZE = (0.15, 0.075, 0.025)
"""Size of the base, in m. Chosen by eye."""
HANDLE_SIZE = (0.020, 0.030, 0.040)
"""Size of the handle, in m; it is narrower than a pad, so that the pad feels its edges."""
GRIP = -0.004
"""Distance of the middle between the pads from the handle's middle along the plug's z, in m. Set once; not tuned."""
WEDGES = 16
"""Number of convex pieces of the ring around the bore."""
DEDENDUM = 1.25
"""Distance from the pitch circle to the root, in modules (ISO 53)."""
RING_OVERLAP = 2e-4
"""Distance by which the ring around the bore and the teeth overlap, in m, at the corners of the ring's pieces. Between the
corners the ring is straight, and gaps of up to 0.26 mm are left in the large gear and 0.06 mm in the medium one."""
NECK_RADIUS = 0.010
"""Radius of the ring between the medium gear and its handle, in m. Chosen by eye."""
GEAR_FRICTION = 0.15
"""Coulomb's friction coefficient of greased gears."""
TIP_POINTS = 24
"""Number of corners of a shaft's chamfer, which lies at most 0.04 mm inside its circle."""
FLANK_POINTS = 5
"""Number of straight pieces of a tooth's flank. Set once; not tuned."""
SHAFT_X = {
    "small": -MODULE * (TEETH["small"] + TEETH["medium"]) / 2,
    "medium": 0.0,
    "large": MODULE * (TEETH["medium"] + TEETH["large"]) / 2,
}
"""Positions of the shafts along the base, in m; the pitch circles of neighbouring gears touch."""
BASE_SHIFT = -0.010
"""Position of the medium shaft along x, seen from the base's middle, in m. Chosen by eye."""
LOOKS = {"small": Look((0.62, 0.10, 0.05)), "medium": Look((0.85, 0.55, 0.05)), "large": Look((0.06, 0.35, 0.12))}
"""Looks of the gears: aluminium that is painted red, yellow and green. Chosen by eye."""


@dataclass(frozen=True)
class ShaftSizes:
    """Sizes of the shafts and of the gears' bores, in m."""

    shaft: float
    """Radius of a shaft."""
    tip: float
    """Radius of a shaft's end, to which it narrows at 45 degrees."""
    bore: float
    """Radius of a gear's bore."""
    clearance: float
    """Largest distance from the shaft's axis at which the gear counts as on it. Our choice."""


SHAFTS = {
    "paper": ShaftSizes(0.0045, 0.0038, 0.0050, 1e-3),  # measured in the meshes of the public code
    "tight": ShaftSizes(0.0050, 0.0050, 0.00515, 5e-4),  # set once; not tuned
}
"""Sizes of the shafts by the name of the fit."""


def tooth_polygon(teeth: int) -> np.ndarray:
    """Outline (n, 2), in m, of the tooth around the x axis: involutes of the base circle from root to tip (ISO 53 proportions).

    Args:
        teeth: Number of the gear's teeth.
    """
    pitch = MODULE * teeth / 2
    base, tip, root = pitch * np.cos(PRESSURE_ANGLE), pitch + MODULE, pitch - DEDENDUM * MODULE
    radius = np.linspace(root, tip, FLANK_POINTS + 1)

    def involute(r: np.ndarray) -> np.ndarray:
        angle = np.arccos(np.clip(base / np.maximum(r, base), -1, 1))
        return np.tan(angle) - angle

    half = np.pi / (2 * teeth) - BACKLASH / (2 * pitch) + involute(np.array([pitch])) - involute(radius)
    return np.concatenate([np.stack([radius * np.cos(s * half), radius * np.sin(s * half)], axis=1) for s in (1, -1)])


def gear_hulls(teeth: int, bore: float, bottom: float, top: float) -> Hulls:
    """Gear about z that has a tooth at +x.

    Args:
        teeth: Number of teeth.
        bore: Radius of the bore, in m.
        bottom: Height of the underside, in m.
        top: Height of the upper side, in m.
    """
    root = MODULE * teeth / 2 - DEDENDUM * MODULE
    pieces = []
    for k in range(teeth):
        turn = 2 * np.pi * k / teeth
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        pieces.append(extruded(tooth_polygon(teeth) @ rotation.T, bottom, top))
    pieces += ring_of_wedges(WEDGES, bore, lambda angles: np.full_like(angles, root + RING_OVERLAP), bottom, top)
    return Hulls(tuple(pieces))


@functools.cache
def neighbour_gear(name: str, fit: str = "paper") -> Part:
    """Gear that turns freely on its shaft. Its frame lies on the axis, in the underside.

    Args:
        name: "small" or "large".
        fit: Name of the fit, which decides the bore.
    """
    return Part(
        f"{name}_gear",
        (gear_hulls(TEETH[name], SHAFTS[one_of("fit", fit, SHAFTS)].bore, 0.0, THICKNESS[name]),),
        LOOKS[name],
        density=ALUMINIUM,
        friction=GEAR_FRICTION,
    )


def gear_fit(fit: str = "paper") -> Fit:
    """The medium gear on its handle, and the base; the gear is held by its handle, and the bore's rim finds the shaft.

    Args:
        fit: "paper" for bores with 0.5 mm of play on each side and chamfered shafts; "tight" for 0.15 mm and blunt shafts.
    """
    sizes = SHAFTS[one_of("fit", fit, SHAFTS)]
    top = HANDLE_SIZE[2] / 2 + RING_HEIGHT
    reach = top + THICKNESS["medium"]
    body = gear_hulls(TEETH["medium"], sizes.bore, top, reach)
    ring = Cylinder(NECK_RADIUS, RING_HEIGHT, (0.0, 0.0, top - RING_HEIGHT / 2))
    return Fit(
        plug=Part(
            "medium_gear",
            (body, ring, Box(HANDLE_SIZE)),
            LOOKS["medium"],
            density=ALUMINIUM,
            friction=GEAR_FRICTION,
            other_looks={2: DARK_PLASTIC},
            other_densities={2: ABS},
        ),
        socket=gear_base(fit),
        reach=reach,
        grip=GRIP,
        grip_width=HANDLE_SIZE[1],
        rim=BASE_SIZE[2] + SHAFT_HEIGHT,
        floor=BASE_SIZE[2],
        pin=(sizes.shaft, sizes.shaft),
        hole=(sizes.bore, sizes.bore),
        clearance=sizes.clearance,
        goes_in_upright=fit == "paper",
        meeting_faces=(MeetingFaces(is_pin_below=True),),
    )


def gear_base(fit: str = "paper") -> Part:
    """Plate with three shafts. Its frame is below the middle shaft, in the plate's underside.

    Args:
        fit: Name of the fit, which decides the shafts.
    """
    sizes = SHAFTS[one_of("fit", fit, SHAFTS)]
    plate = Box(BASE_SIZE, (-BASE_SHIFT, 0.0, BASE_SIZE[2] / 2))
    shafts = [piece for x in SHAFT_X.values() for piece in _shaft(sizes, x)]
    return Part(
        "gear_base",
        (plate, *shafts),
        BLUE_PLASTIC,
        friction=GEAR_FRICTION,
        other_looks=dict.fromkeys(range(1, 1 + len(shafts)), STEEL),
    )


def _shaft(sizes: ShaftSizes, x: float) -> list[Piece]:
    """A shaft on the plate, and its chamfered end."""
    cut = sizes.shaft - sizes.tip
    height = SHAFT_HEIGHT - cut
    cylinder = Cylinder(sizes.shaft, height, (x, 0.0, BASE_SIZE[2] + height / 2))
    if not cut:
        return [cylinder]
    angles = 2 * np.pi * np.arange(TIP_POINTS) / TIP_POINTS
    circle, top = np.c_[np.cos(angles), np.sin(angles)], BASE_SIZE[2] + SHAFT_HEIGHT
    rings = [(radius * circle + (x, 0.0), z) for radius, z in ((sizes.shaft, top - cut), (sizes.tip, top))]
    return [cylinder, Hulls((lofted(rings),))]
