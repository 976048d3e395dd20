"""Spur gears that mesh: involute teeth on a ring of wedges around the bore, and the base whose shafts they turn on."""

import functools
from dataclasses import dataclass

import numpy as np

from manifeel_ms3.rendering.looks import BLUE_PLASTIC, DARK_PLASTIC, STEEL, Look

from .fits import ABOVE_RIM, Fit, Lead
from .materials import ABS, ALUMINIUM
from .part import Box, Cylinder, Hulls, Part, Piece, extruded, lofted, ring_of_wedges

MODULE = 0.002  # m: pitch diameter per tooth
PRESSURE_ANGLE = np.deg2rad(20.0)
BACKLASH = 4e-4  # m along the pitch circle, by which each gear's teeth are thinner than half the pitch
TEETH = {"small": 9, "medium": 19, "large": 29}  # 22, 42 and 62 mm across
THICKNESS = {"small": 0.014, "medium": 0.020, "large": 0.014}  # m
SHAFT_HEIGHT = 0.018  # m
RING_HEIGHT = 0.005  # m, between the medium gear and its handle
BASE_SIZE = (0.15, 0.075, 0.025)  # m
HANDLE_SIZE = (0.020, 0.030, 0.040)  # m; narrower than a pad, so that touch sees its edges
GRIP = -0.004  # m, from the handle's middle
WEDGES = 16  # number of convex pieces of the ring around the bore
DEDENDUM = 1.25  # modules, from the pitch circle to the root (ISO 53)
RING_OVERLAP = 2e-4  # m, of the ring and the teeth, so that no gap is between them
NECK_RADIUS = 0.010  # m, of the ring between the gear and its handle
LEAN = (np.deg2rad(7.0), np.deg2rad(5.0))  # along x and y, with which the bore's rim goes ahead; tuned
GEAR_FRICTION = 0.15  # greased
BESIDE = 0.0022  # m from the shaft's side to where the bore's rim is set down; tuned
TIP_POINTS = 24  # number of corners of a shaft's chamfer; 0.04 mm inside its circle at most
FLANK_POINTS = 5
# along the base: neighbours at the distance of their pitch circles
SHAFT_X = {
    "small": -MODULE * (TEETH["small"] + TEETH["medium"]) / 2,
    "medium": 0.0,
    "large": MODULE * (TEETH["medium"] + TEETH["large"]) / 2,
}
BASE_SHIFT = -0.010  # m: the base's middle, seen from the medium shaft
LOOKS = {"small": Look((0.62, 0.10, 0.05)), "medium": Look((0.85, 0.55, 0.05)), "large": Look((0.06, 0.35, 0.12))}


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
    """Largest distance from the shaft's axis at which the gear counts as on it; chosen by hand."""


SHAFTS = {
    "paper": ShaftSizes(0.0045, 0.0038, 0.0050, 1e-3),  # measured in the meshes of the public code
    "tight": ShaftSizes(0.0050, 0.0050, 0.00515, 5e-4),
}


def tooth_polygon(teeth: int) -> np.ndarray:
    """Outline (n, 2), m, of the tooth about the x axis, from root to tip: involutes of the base circle (ISO 53 proportions)."""
    pitch = MODULE * teeth / 2
    base, tip, root = pitch * np.cos(PRESSURE_ANGLE), pitch + MODULE, pitch - DEDENDUM * MODULE
    radius = np.linspace(root, tip, FLANK_POINTS + 1)

    def involute(r: np.ndarray) -> np.ndarray:
        angle = np.arccos(np.clip(base / np.maximum(r, base), -1, 1))
        return np.tan(angle) - angle

    half = np.pi / (2 * teeth) - BACKLASH / (2 * pitch) + involute(np.array([pitch])) - involute(radius)
    return np.concatenate([np.stack([radius * np.cos(s * half), radius * np.sin(s * half)], axis=1) for s in (1, -1)])


def gear_hulls(teeth: int, bore: float, bottom: float, top: float) -> Hulls:
    """Gear about z with a bore of this radius, in m, between two heights, in the phase that has a tooth at +x."""
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
    """The "small" or the "large" gear, which turns on its shaft; its frame on the axis, in the underside."""
    return Part(
        f"{name}_gear",
        (gear_hulls(TEETH[name], SHAFTS[fit].bore, 0.0, THICKNESS[name]),),
        LOOKS[name],
        density=ALUMINIUM,
        friction=GEAR_FRICTION,
    )


def gear_fit(fit: str = "paper") -> Fit:
    """The medium gear on its handle, and the base; the gear is held by its handle, and the bore's rim finds the shaft.

    Args:
        fit: "paper" for bores with 0.5 mm of play on each side and chamfered shafts; "tight" for 0.15 mm and blunt ones.
    """
    sizes = SHAFTS[fit]
    top = HANDLE_SIZE[2] / 2 + RING_HEIGHT
    reach = top + THICKNESS["medium"]
    body = gear_hulls(TEETH["medium"], sizes.bore, top, reach)
    ring = Cylinder(NECK_RADIUS, RING_HEIGHT, (0.0, 0.0, top - RING_HEIGHT / 2))
    diagonal = np.sqrt(0.5)
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
        corner=(-diagonal * sizes.bore,) * 2,
        aim=(-diagonal * (sizes.shaft + BESIDE),) * 2,
        lean=LEAN,
        clearance=sizes.clearance,
        goes_in_upright=fit == "paper",
        leads=(Lead(ABOVE_RIM, is_pin_below=True),),
    )


def gear_base(fit: str = "paper") -> Part:
    """Plate with three shafts; its frame below the middle shaft, in the plate's underside."""
    sizes = SHAFTS[fit]
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
