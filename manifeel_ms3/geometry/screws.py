"""Parts that are screwed together: an M16 nut and bolt, an E27 bulb and its holder."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
import trimesh

from manifeel_ms3.rendering import looks

from .materials import STEEL
from .part import Ball, Box, Cylinder, Hulls, Part, Solid, ring_of_wedges
from .threads import FLANK, edison, external_mesh, internal_mesh, iso_metric, ridge

Height = TypeVar("Height", float, np.ndarray, torch.Tensor)


@dataclass(frozen=True)
class Screw:
    """A held part with a thread, and the fixed one that it is screwed onto or into.

    Frames: the held part's on its axis, in the middle of what is held, z up when it is in place; the fixed part's in the middle
    of its underside, z up. Lengths in m.
    """

    held: Part
    fixed: Part
    grip_width: float
    """Width that the pads close on."""
    engaged: float
    """Height of the held part's origin over the underside of the fixed one where the threads first meet."""
    pitch: float
    """Height of one turn of the thread."""
    seated: float
    """Height of the held part's origin over the underside of the fixed one where it is far enough in."""
    tightening: float
    """Angle, in rad, by which the held part is turned further once it is at the height `seated`."""
    reach: float
    """Distance below the held part's origin at which its thread begins."""
    symmetry: float
    """Angle, in rad, between two equivalent grips."""
    grip_force: float
    """Force of each pad, in N."""


GREASED_FRICTION = 0.15  # Coulomb's coefficient of greased steel
M16 = iso_metric(0.008, 0.002)  # ISO 261, coarse pitch
M16_POINT = 0.006  # m: radius of the flat point (ISO 4753)
BOLT_FOOT, BOLT_LENGTH = 0.030, 0.024  # m: plate and head; thread
NUT_ACROSS_FLATS, NUT_HEIGHT, NUT_WALL = 0.024, 0.013, 0.0083  # m; the wall is the ridge's root
PLATE_SIZE, PLATE_HEIGHT, HEAD_BORE = 0.06, 0.02, 0.001  # m; the head is a ring of wedges around a pinhole
PIECES_PER_TURN = 24  # convex pieces of one turn of a ridge
HEX_WEDGES = 12  # two convex pieces for each side of a hexagon
BOLT_TURN = np.deg2rad(-15)  # so that the threads meet soon after the hand begins to turn
NUT_GAP, NUT_CREST_GAP, NUT_TURNS, NUT_MOUTH = 1e-4, 2e-4, 2.0, 0.0015  # m; the mouth is below the ridge
NUT_DESCENT = 1.5  # pitches from the first contact of the threads to the goal
NUT_TIGHTENING, NUT_SYMMETRY, NUT_GRIP_FORCE = np.deg2rad(40), np.deg2rad(60), 27.0  # rad; rad, of a hexagon; N
NUT_ENGAGED = 0.0018  # m: its middle over the bolt's end, where the ridge's lower end just passes under the end of the crest


def hexagon(across_flats: float) -> Callable[[np.ndarray], np.ndarray]:
    """Radius (n,) of a hexagon, one flat facing y, at angles (n,)."""
    return lambda angles: across_flats / 2 / np.cos(angles % (np.pi / 3) - np.pi / 6)


def m16_bolt() -> Part:
    """M16 bolt, standing on its head in a plate."""
    head = ring_of_wedges(HEX_WEDGES, HEAD_BORE, hexagon(NUT_ACROSS_FLATS), PLATE_HEIGHT, BOLT_FOOT)
    shank = external_mesh(M16, BOLT_LENGTH, M16_POINT)
    shank.apply_transform(trimesh.transformations.rotation_matrix(BOLT_TURN, [0, 0, 1]))
    shank.apply_translation([0, 0, BOLT_FOOT])
    plate = Box((PLATE_SIZE, PLATE_SIZE, PLATE_HEIGHT), (0.0, 0.0, PLATE_HEIGHT / 2))
    return Part(
        "bolt",
        (plate, Hulls(tuple(head)), Solid(shank)),
        looks.STEEL,
        friction=GREASED_FRICTION,
        other_looks={0: looks.BLUE_PLASTIC},
    )


def m16_nut() -> Part:
    """Hexagon nut, 24 mm across flats, two turns of ridge in its lower half."""
    inner, root = M16.minor_radius + NUT_CREST_GAP, NUT_WALL / np.cos(np.pi / (2 * HEX_WEDGES))

    def half_width(radius: float) -> float:
        return M16.pitch / 8 + (radius - M16.minor_radius) * FLANK - NUT_GAP

    section = np.array([[r, side * half_width(r)] for r in (inner, root) for side in (-1, 1)])
    section[:, 1] += NUT_MOUTH + M16.pitch / 2 - NUT_HEIGHT / 2
    wedges = ring_of_wedges(HEX_WEDGES, NUT_WALL, hexagon(NUT_ACROSS_FLATS), -NUT_HEIGHT / 2, NUT_HEIGHT / 2)
    pieces = (*wedges, *ridge(section, M16.pitch, NUT_TURNS, PIECES_PER_TURN))
    return Part("nut", (Hulls(pieces),), looks.STEEL, density=STEEL, friction=GREASED_FRICTION)


def nut_and_bolt() -> Screw:
    """The M16 nut and its bolt."""
    return Screw(
        held=m16_nut(),
        fixed=m16_bolt(),
        grip_width=NUT_ACROSS_FLATS,
        engaged=BOLT_FOOT + BOLT_LENGTH + NUT_ENGAGED,
        pitch=M16.pitch,
        seated=BOLT_FOOT + BOLT_LENGTH + NUT_ENGAGED - NUT_DESCENT * M16.pitch,
        tightening=NUT_TIGHTENING,
        reach=NUT_HEIGHT / 2,
        symmetry=NUT_SYMMETRY,
        grip_force=NUT_GRIP_FORCE,
    )


# IEC 60061-1: cap 7004-21, holder 7005-20, both in the middle of their tolerances
E27 = edison(major_radius=0.013125, pitch=0.003629, arc=0.001025, points=3)
E27_GAP, GUIDE = 2.0e-4, 1.0e-3  # m, radial: between the threads, and of the smooth wall around them
GLASS_RADIUS = 0.030
CAP_TOP, CAP_FOOT, CAP_TIP = -0.036, -0.058, -0.066  # m, heights under the glass's middle
CAP_RIDGE, CAP_TURNS = -0.056, 1.5
RIDGE_OVERLAP = 5e-4  # m, by which the cap's ridge reaches into its core, so that no gap is between them
NECK_RADIUS, NECK_TOP = 0.018, -0.024  # m; where the neck meets the glass's sphere, from its middle
FOOT_RADIUS = 0.005  # m: the insulator narrows to it
TIP_RADIUS, TIP_HEIGHT = 0.004, 0.003  # m: the contact at the foot
TIP_OVERHANG = 0.001  # m, by which the contact stands out of the insulator
CONE_CORNERS = 24  # of the convex pieces of neck, cap and foot
HOLDER_SECTIONS = 64  # straight sides of the holder's round wall
THREAD_OVERLAP = 1e-4  # m, by which the holder's thread reaches into its wall, so that no gap is between them
HOLDER_RADIUS, HOLDER_HEIGHT = 0.022, 0.035  # m
CONTACT_HEIGHT = 0.012  # m, over the underside
BORE = (0.018, 0.0288)  # m: the thread's ends, the upper one with the mouth's chamfer
BORE_TURN = np.deg2rad(-10)  # the hand turns by 80 degrees before the threads meet, while the cap finds its place in the mouth
CONTACT_SPRING = 5e4  # N/m at each contact point: tightening by a tenth of a turn makes 0.3 N m of the thread
DRY_FRICTION = 0.35  # Coulomb's coefficient of brass on brass, neither greased nor polished
LEAD_IN = 0.25  # turns over which the cap's ridge rises
BULB_TIGHTENING, BULB_SYMMETRY, BULB_GRIP_FORCE = np.deg2rad(120), np.deg2rad(15), 12.0  # rad, tuned; rad; N
BULB_DENSITY = 400.0  # kg/m^3, of the whole, which is hollow: 53 g, of the 50 to 60 g of an LED lamp of this size (data sheets)
BULB_SEATED = CONTACT_HEIGHT - CAP_TIP
BULB_TRAVEL = 0.0034  # m down from where the ridge's lower end just passes under the bore's crest


def _cone(radii: tuple[float, float], heights: tuple[float, float]) -> np.ndarray:
    angle = 2 * np.pi * np.arange(CONE_CORNERS) / CONE_CORNERS
    return np.concatenate(
        [np.c_[r * np.cos(angle), r * np.sin(angle), np.full(CONE_CORNERS, z)] for r, z in zip(radii, heights, strict=True)]
    )


def bulb_yaw(height: Height) -> Height:
    """Yaw, in rad, of a bulb whose ridge lies in the middle of the holder's groove.

    Args:
        height: Height of the glass's centre over the holder's underside, in m.
    """
    return BORE_TURN + 2 * np.pi * (height + CAP_RIDGE - BORE[0]) / E27.pitch


def e27_bulb() -> Part:
    """Light bulb: glass, neck, and a cap with one and a half turns of thread, an insulator and a contact at its foot."""
    core = E27.minor_radius
    crest = np.array([(radius, height) for height, radius in E27.profile if abs(height) < E27.pitch / 3])
    section = np.r_[crest, [[core - RIDGE_OVERLAP, side * E27.pitch / 4] for side in (-1, 1)]]
    section[:, 1] += CAP_RIDGE
    neck = _cone((NECK_RADIUS, core), (NECK_TOP, CAP_TOP))
    cap = (_cone((core, core), (CAP_TOP, CAP_FOOT)), *ridge(section, E27.pitch, CAP_TURNS, PIECES_PER_TURN, lead_in=LEAD_IN))
    foot = _cone((core, FOOT_RADIUS), (CAP_FOOT, CAP_TIP + TIP_OVERHANG))
    tip = Cylinder(TIP_RADIUS, TIP_HEIGHT, (0.0, 0.0, CAP_TIP + TIP_HEIGHT / 2))
    return Part(
        "bulb",
        (Ball(GLASS_RADIUS), Hulls((neck,)), Hulls(cap), Hulls((foot,)), tip),
        looks.OPAL_GLASS,
        density=BULB_DENSITY,
        friction=DRY_FRICTION,
        other_looks={2: looks.STEEL, 3: looks.BLACK_PLASTIC, 4: looks.BRASS},
    )


def e27_holder() -> Part:
    """Lampholder with an inner thread below its rim, and a contact at the bottom."""
    bore = E27.wider(E27_GAP)
    mouth = bore.major_radius + GUIDE
    thread = internal_mesh(bore, BORE[1] - BORE[0], mouth + THREAD_OVERLAP)
    thread.apply_transform(trimesh.transformations.rotation_matrix(BORE_TURN, [0, 0, 1]))
    thread.apply_translation([0, 0, BORE[0]])

    shell = trimesh.creation.annulus(mouth, HOLDER_RADIUS, HOLDER_HEIGHT, sections=HOLDER_SECTIONS)
    shell.apply_translation([0, 0, HOLDER_HEIGHT / 2])
    contact = Cylinder(mouth, CONTACT_HEIGHT, (0.0, 0.0, CONTACT_HEIGHT / 2))
    return Part(
        "holder",
        (Solid(shell), Solid(thread), contact),
        looks.DARK_PLASTIC,
        friction=DRY_FRICTION,
        other_looks={1: looks.STEEL, 2: looks.BRASS},
        springs={2: CONTACT_SPRING},
    )


def bulb_and_holder() -> Screw:
    """The E27 bulb and its holder."""
    return Screw(
        held=e27_bulb(),
        fixed=e27_holder(),
        grip_width=2 * GLASS_RADIUS,
        engaged=BULB_SEATED + BULB_TRAVEL,
        pitch=E27.pitch,
        seated=BULB_SEATED,
        tightening=BULB_TIGHTENING,
        reach=-CAP_FOOT,
        symmetry=BULB_SYMMETRY,
        grip_force=BULB_GRIP_FORCE,
    )
