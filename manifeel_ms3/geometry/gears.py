"""Spur gears that mesh: involute teeth on a ring of wedges around the bore, and the base whose shafts they turn on."""

import functools

import numpy as np

from .fits import Fit
from .materials import ABS, ALUMINIUM
from .part import Box, Cylinder, Hulls, Part, extruded, ring_of_wedges

MODULE = 0.002  # m: pitch diameter per tooth
PRESSURE_ANGLE = np.deg2rad(20.0)
BACKLASH = 4e-4  # m along the pitch circle, by which each gear's teeth are thinner than half the pitch
TEETH = {"small": 9, "medium": 19, "large": 29}  # 22, 42 and 62 mm across
THICKNESS = {"small": 0.014, "medium": 0.020, "large": 0.014}  # m
SHAFT_RADIUS, SHAFT_HEIGHT, BORE_GAP = 0.005, 0.018, 1.5e-4  # m; the gap is the bore's, on each side
RING_HEIGHT = 0.005  # m, between the medium gear and its handle
BASE_SIZE = (0.15, 0.075, 0.025)  # m
HANDLE_SIZE = (0.020, 0.030, 0.040)  # m; narrower than a pad, so that touch sees its edges
WEDGES = 16  # number of convex pieces of the ring around the bore
DEDENDUM = 1.25  # modules, from the pitch circle to the root (ISO 53)
RING_OVERLAP = 2e-4  # m, of the ring and the teeth, so that no gap is between them
NECK_RADIUS = 0.010  # m, of the ring between the gear and its handle
LEAN = (np.deg2rad(7.0), np.deg2rad(5.0))  # along x and y, with which the bore's rim goes ahead; tuned
GEAR_FRICTION = 0.15  # greased
BESIDE = 0.0022  # m from the shaft's side to where the bore's rim is set down
FLANK_POINTS = 5
# along the base: neighbours at the distance of their pitch circles
SHAFT_X = {
    "small": -MODULE * (TEETH["small"] + TEETH["medium"]) / 2,
    "medium": 0.0,
    "large": MODULE * (TEETH["medium"] + TEETH["large"]) / 2,
}
BASE_SHIFT = -0.010  # m: the base's middle, seen from the medium shaft
COLOURS = {"small": (0.75, 0.35, 0.25), "medium": (0.80, 0.62, 0.20), "large": (0.30, 0.50, 0.35)}


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


def gear_hulls(teeth: int, bottom: float, top: float) -> Hulls:
    """Gear about z between two heights, in the phase that has a tooth at +x."""
    root = MODULE * teeth / 2 - DEDENDUM * MODULE
    bore = SHAFT_RADIUS + BORE_GAP
    pieces = []
    for k in range(teeth):
        turn = 2 * np.pi * k / teeth
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        pieces.append(extruded(tooth_polygon(teeth) @ rotation.T, bottom, top))
    pieces += ring_of_wedges(WEDGES, bore, lambda angles: np.full_like(angles, root + RING_OVERLAP), bottom, top)
    return Hulls(tuple(pieces))


@functools.cache
def neighbour_gear(name: str) -> Part:
    """The "small" or the "large" gear, which turns on its shaft; its frame on the axis, in the underside."""
    return Part(
        f"{name}_gear",
        (gear_hulls(TEETH[name], 0.0, THICKNESS[name]),),
        COLOURS[name],
        density=ALUMINIUM,
        friction=GEAR_FRICTION,
    )


def gear_fit() -> Fit:
    """The medium gear on its handle, and the base; the gear is held by its handle, and the bore's rim finds the shaft."""
    top = HANDLE_SIZE[2] / 2 + RING_HEIGHT
    reach = top + THICKNESS["medium"]
    body = gear_hulls(TEETH["medium"], top, reach)
    ring = Cylinder(NECK_RADIUS, RING_HEIGHT, (0.0, 0.0, top - RING_HEIGHT / 2))
    diagonal = np.sqrt(0.5)
    return Fit(
        plug=Part(
            "medium_gear",
            (body, ring, Box(HANDLE_SIZE)),
            COLOURS["medium"],
            density=ALUMINIUM,
            friction=GEAR_FRICTION,
            other_colours={2: (0.14, 0.14, 0.16)},
            other_densities={2: ABS},
        ),
        socket=gear_base(),
        reach=reach,
        grip=-0.004,
        grip_width=HANDLE_SIZE[1],
        rim=BASE_SIZE[2] + SHAFT_HEIGHT,
        floor=BASE_SIZE[2],
        corner=(-diagonal * (SHAFT_RADIUS + BORE_GAP),) * 2,
        aim=(-diagonal * (SHAFT_RADIUS + BESIDE),) * 2,
        lean=LEAN,
        clearance=5e-4,
    )


def gear_base() -> Part:
    """Plate with three shafts; its frame below the middle shaft, in the plate's underside."""
    plate = Box(BASE_SIZE, (-BASE_SHIFT, 0.0, BASE_SIZE[2] / 2))
    shafts = [Cylinder(SHAFT_RADIUS, SHAFT_HEIGHT, (x, 0.0, BASE_SIZE[2] + SHAFT_HEIGHT / 2)) for x in SHAFT_X.values()]
    return Part(
        "gear_base",
        (plate, *shafts),
        (0.25, 0.35, 0.55),
        friction=GEAR_FRICTION,
        other_colours=dict.fromkeys((1, 2, 3), (0.7, 0.7, 0.72)),
    )
