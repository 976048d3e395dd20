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

    Frames: the held part's has its origin on the part's axis, midway between the pads, and z up when the part is in place; the
    fixed part's lies in the middle of its underside, z up. Lengths are in m.
    """

    held: Part
    """The part that the hand turns."""
    fixed: Part
    """The part on the table."""
    grip_width: float
    """Width that the pads close on."""
    engaged: float
    """Height of the held part's origin over the underside of the fixed one where the threads first meet."""
    pitch: float
    """Height of one turn of the thread."""
    seated: float
    """Height of the held part's origin over the underside of the fixed one at which it is far enough in."""
    reach: float
    """Distance below the held part's origin at which its thread begins."""
    symmetry: float
    """Angle, in rad, between two equivalent grips."""
    grip_force: float
    """Force of each pad, in N."""


GREASED_FRICTION = 0.15
"""Coulomb's friction coefficient of greased steel."""
M16 = iso_metric(0.008, 0.002)
"""Thread of nut and bolt (ISO 261, coarse pitch)."""
M16_POINT = 0.006
"""Radius of the bolt's flat point, in m (ISO 4753)."""
BOLT_FOOT, BOLT_LENGTH = 0.030, 0.024
"""Height at which the bolt's thread begins, above plate and head, and length of the thread, in m. Set once; not tuned."""
NUT_ACROSS_FLATS, NUT_HEIGHT = 0.024, 0.013
"""Width of the nut across flats, and its height, in m (DIN 934)."""
NUT_WALL = 0.0083
"""Radius of the bore between the turns of the nut's ridge, in m: just wider than the bolt. Set once; not tuned."""
PLATE_SIZE, PLATE_HEIGHT = 0.06, 0.02
"""Side and height of the plate below the bolt, in m. Chosen by eye."""
HEAD_BORE = 0.001
"""Radius of the pinhole in the bolt's head, in m: the head is a ring of convex wedges, which needs one."""
PIECES_PER_TURN = 24
"""Number of convex pieces of one turn of a ridge. Set once; not tuned."""
HEX_WEDGES = 12
"""Number of convex pieces of a hexagon: two for each side."""
BOLT_TURN = np.deg2rad(-15)
"""Rotation of the bolt about its axis, in rad, with which the threads meet soon after the hand begins to turn."""
NUT_GAP, NUT_CREST_GAP = 1e-4, 2e-4
"""Gaps between nut and bolt, in m: along the axis at each flank, and at the ridge's crest. Set once; not tuned."""
NUT_TURNS, NUT_MOUTH = 2.0, 0.0015
"""Number of turns of the nut's ridge, and height of the free mouth below it, in m. Set once; not tuned."""
NUT_DESCENT = 1.5
"""Descent of the nut from the first contact of the threads to the goal, in pitches. Our choice."""
NUT_SYMMETRY = np.deg2rad(60)
"""Symmetry of a hexagon, in rad."""
NUT_GRIP_FORCE = 27.0
"""Force of each pad on the nut at the start, in N. Set once; not tuned. The fingers' range leaves 22 N of it from the
first action on (`FINGER_RANGE` in agents/panda_gelsight.py)."""
NUT_ENGAGED = 0.0018
"""Height of the nut's middle over the bolt's end, in m, at which the ridge's lower end just passes under the end of
the crest."""


def hexagon(across_flats: float) -> Callable[[np.ndarray], np.ndarray]:
    """Function from angles (n,), in rad, to the radii of a hexagon there, one of whose flats faces y; lengths in m."""
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
    """M16 hexagon nut, 24 mm across flats, whose thread is a ridge of two turns in its lower half."""
    inner, root = M16.minor_radius + NUT_CREST_GAP, NUT_WALL / np.cos(np.pi / (2 * HEX_WEDGES))

    def half_width(radius: float) -> float:
        return M16.pitch / 8 + (radius - M16.minor_radius) * FLANK - NUT_GAP

    section = np.array([[r, side * half_width(r)] for r in (inner, root) for side in (-1, 1)])
    section[:, 1] += NUT_MOUTH + M16.pitch / 2 - NUT_HEIGHT / 2
    wedges = ring_of_wedges(HEX_WEDGES, NUT_WALL, hexagon(NUT_ACROSS_FLATS), -NUT_HEIGHT / 2, NUT_HEIGHT / 2)
    pieces = (*wedges, *ridge(section, M16.pitch, NUT_TURNS, PIECES_PER_TURN))
    return Part("nut", (Hulls(pieces),), looks.STEEL, density=STEEL, friction=GREASED_FRICTION)


def nut_and_bolt() -> Screw:
    """M16 nut and its bolt."""
    return Screw(
        held=m16_nut(),
        fixed=m16_bolt(),
        grip_width=NUT_ACROSS_FLATS,
        engaged=BOLT_FOOT + BOLT_LENGTH + NUT_ENGAGED,
        pitch=M16.pitch,
        seated=BOLT_FOOT + BOLT_LENGTH + NUT_ENGAGED - NUT_DESCENT * M16.pitch,
        reach=NUT_HEIGHT / 2,
        symmetry=NUT_SYMMETRY,
        grip_force=NUT_GRIP_FORCE,
    )


E27 = edison(major_radius=0.013125, pitch=0.003629, arc=0.001025, points=3)
"""Thread of bulb and holder (IEC 60061-1: cap 7004-21, holder 7005-20, both in the middle of their tolerances)."""
E27_GAP, GUIDE = 2.0e-4, 1.0e-3
"""Radial gaps, in m: between the two threads, and of the holder's smooth wall around its thread. Set once; not tuned."""
GLASS_RADIUS = 0.030
"""Radius of the glass, in m. Chosen by eye."""
CAP_TOP, CAP_FOOT, CAP_TIP = -0.036, -0.058, -0.066
"""Heights of the cap's upper end, of its lower end and of the contact's end, in m over the glass's middle."""
CAP_RIDGE, CAP_TURNS = -0.056, 1.5
"""Height of the lower end of the cap's ridge, in m over the glass's middle, and number of its turns."""
RIDGE_OVERLAP = 5e-4
"""Length by which the cap's ridge reaches into its core, in m, so that no gap is between them."""
NECK_RADIUS, NECK_TOP = 0.018, -0.024
"""Radius and height at which the neck meets the glass's sphere, in m from its middle: on a radius of 30 mm."""
FOOT_RADIUS = 0.005
"""Radius to which the insulator at the cap's foot narrows, in m. Chosen by eye."""
TIP_RADIUS, TIP_HEIGHT = 0.004, 0.003
"""Radius and height of the contact at the cap's foot, in m. Chosen by eye."""
TIP_OVERHANG = 0.001
"""Length by which the contact stands out of the insulator, in m. Chosen by eye."""
CONE_CORNERS = 24
"""Number of corners of the convex pieces of neck, cap and foot. Set once; not tuned."""
HOLDER_SECTIONS = 64
"""Number of straight sides of the holder's round wall. Set once; not tuned."""
THREAD_OVERLAP = 1e-4
"""Length by which the holder's thread reaches into its wall, in m, so that no gap is between them."""
HOLDER_RADIUS, HOLDER_HEIGHT = 0.022, 0.035
"""Outer radius and height of the holder, in m. Chosen by eye."""
BASE_RADIUS, BASE_HEIGHT = 0.05, 0.006
"""Radius and height of the base on which the holder stands, in m. Over the holder, the bulb's glass hides it from the wrist
camera; the base, which is wider than the glass, shows where it is. Chosen by eye."""
CONTACT_HEIGHT = 0.012
"""Height of the holder's contact over the underside, in m. Chosen by eye."""
BORE = (0.018, 0.0288)
"""Heights of the lower and the upper end of the holder's thread over the underside, in m; the mouth's chamfer is part of it."""
BORE_TURN = np.deg2rad(-10)
"""Rotation of the holder's thread about its axis, in rad. The hand turns by 80 degrees before the threads meet, while
the cap finds its place in the mouth."""
CONTACT_SPRING = 5e4
"""Stiffness of the holder's contact, in N/m at each contact point: a tenth of a turn tightens the thread by 0.3 N m."""
DRY_FRICTION = 0.35
"""Coulomb's friction coefficient of brass on brass, neither greased nor polished."""
GLASS_FRICTION = 1.0
"""Coulomb's friction coefficient of the glass. PhysX averages it with the gel's 0.5, so that a pad holds the bulb with 0.75,
the lower end of what is measured of silicone gels (0.75 to 1). Flat parts do with less, because PhysX gives a face twice the
torque of an even pressure, and a round part none of it (docs/sensor.md)."""
LEAD_IN = 0.25
"""Number of turns over which the cap's ridge rises. Set once; not tuned."""
BULB_SYMMETRY = np.deg2rad(15)
"""Step of the angles at which the round bulb is grasped, in rad. Set once; not tuned."""
BULB_GRIP_FORCE = 12.0
"""Force of each pad on the bulb at the start, in N. Set once; not tuned. From the first action on it is 11 N."""
BULB_DENSITY = 400.0
"""Density of the whole bulb, which is hollow, in kg/m^3: it has 53 g; LED lamps of this size have 50 to 60 g (data sheets)."""
BULB_SEATED = CONTACT_HEIGHT - CAP_TIP
"""Height of the glass's middle over the holder's underside, in m, at which the two contacts meet."""
BULB_TRAVEL = 0.0034
"""Descent of the bulb to `BULB_SEATED`, in m, from where the ridge's lower end just passes under the crest of the
holder's thread."""


def _cone(radii: tuple[float, float], heights: tuple[float, float]) -> np.ndarray:
    """Points (n, 3), in m, of a cone about z with a radius at each of two heights."""
    angle = 2 * np.pi * np.arange(CONE_CORNERS) / CONE_CORNERS
    return np.concatenate(
        [np.c_[r * np.cos(angle), r * np.sin(angle), np.full(CONE_CORNERS, z)] for r, z in zip(radii, heights, strict=True)]
    )


def bulb_yaw(height: Height) -> Height:
    """Yaw, in rad, at which a bulb's ridge lies in the middle of the holder's groove.

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
        friction=GLASS_FRICTION,
        other_frictions=dict.fromkeys((2, 3, 4), DRY_FRICTION),
        other_looks={2: looks.STEEL, 3: looks.BLACK_PLASTIC, 4: looks.BRASS},
    )


def e27_holder() -> Part:
    """Lampholder on a wide base, with an inner thread below its rim, and a contact at the bottom."""
    bore = E27.wider(E27_GAP)
    mouth = bore.major_radius + GUIDE
    thread = internal_mesh(bore, BORE[1] - BORE[0], mouth + THREAD_OVERLAP)
    thread.apply_transform(trimesh.transformations.rotation_matrix(BORE_TURN, [0, 0, 1]))
    thread.apply_translation([0, 0, BORE[0]])

    shell = trimesh.creation.annulus(mouth, HOLDER_RADIUS, HOLDER_HEIGHT, sections=HOLDER_SECTIONS)
    shell.apply_translation([0, 0, HOLDER_HEIGHT / 2])
    contact = Cylinder(mouth, CONTACT_HEIGHT, (0.0, 0.0, CONTACT_HEIGHT / 2))
    base = Cylinder(BASE_RADIUS, BASE_HEIGHT, (0.0, 0.0, BASE_HEIGHT / 2))
    return Part(
        "holder",
        (Solid(shell), Solid(thread), contact, base),
        looks.DARK_PLASTIC,
        friction=DRY_FRICTION,
        other_looks={1: looks.STEEL, 2: looks.BRASS, 3: looks.BLUE_PLASTIC},
        springs={2: CONTACT_SPRING},
    )


def bulb_and_holder() -> Screw:
    """E27 bulb and its holder."""
    return Screw(
        held=e27_bulb(),
        fixed=e27_holder(),
        grip_width=2 * GLASS_RADIUS,
        engaged=BULB_SEATED + BULB_TRAVEL,
        pitch=E27.pitch,
        seated=BULB_SEATED,
        reach=-CAP_FOOT,
        symmetry=BULB_SYMMETRY,
        grip_force=BULB_GRIP_FORCE,
    )
