"""Threads that really turn: an external thread as one triangle mesh, an internal one as a row of convex ridge pieces.

Triangle meshes collide with convex shapes alone, so that of every mating pair one side is made of pieces. Profile: 60 degrees,
crest flat of an eighth and root flat of a quarter of the pitch (ISO 68-1). Right-handed.
"""

from dataclasses import dataclass

import numpy as np
import trimesh

from .part import Hulls, Part, Solid, ring_of_wedges

FLANK = np.tan(np.deg2rad(30.0))


@dataclass(frozen=True)
class Thread:
    """External thread about z, from z = 0 to `length`, chamfered at the top. Lengths in m."""

    major_radius: float
    pitch: float
    length: float

    @property
    def depth(self) -> float:
        """From crest to root: what is left of half the pitch after half of both flats, along the flank."""
        return (0.5 - 1 / 16 - 1 / 8) * self.pitch / FLANK

    @property
    def minor_radius(self) -> float:
        return self.major_radius - self.depth

    def groove_half_width(self, radius: float) -> float:
        """Of the groove at a radius, along z."""
        return self.pitch / 8 + (radius - self.minor_radius) * FLANK


def external_mesh(thread: Thread, per_turn: int = 32) -> trimesh.Trimesh:
    """Closed surface of an external thread, its crest at z = 0 at angle 0."""
    p, low, high = thread.pitch, thread.minor_radius, thread.major_radius
    # along one pitch: crest from -1/16 to 1/16, flank to 6/16, root to 10/16, flank to 15/16
    places = np.array([-1 / 16, 1 / 16, 6 / 16, 10 / 16]) * p
    radii = np.array([high, high, low, low])
    turns = int(np.ceil(thread.length / p)) + 3
    u = np.concatenate([(n - 2) * p + places for n in range(turns)])
    r = np.tile(radii, turns)
    angle = 2 * np.pi * np.arange(per_turn) / per_turn
    z = np.clip(u[None] + p * angle[:, None] / (2 * np.pi), 0.0, thread.length)
    chamfer = low - 2e-4 + (thread.length - z)  # 45 degrees
    radius = np.minimum(np.broadcast_to(r, z.shape), np.maximum(chamfer, low - 2e-4))
    rim = np.stack([radius * np.cos(angle)[:, None], radius * np.sin(angle)[:, None], z], axis=-1)  # (per_turn, J, 3)
    count = len(u)
    vertices = [*rim.reshape(-1, 3), [0, 0, 0], [0, 0, thread.length]]
    bottom, top = len(vertices) - 2, len(vertices) - 1
    faces = []
    for k in range(per_turn):
        ahead, shift = ((k + 1) * count, 0) if k + 1 < per_turn else (0, len(places))  # a turn on, one pitch up
        for j in range(count - 1 - shift):
            a, b, c, d = k * count + j, ahead + j + shift, ahead + j + shift + 1, k * count + j + 1
            faces += [[a, b, c], [a, c, d]]
        faces.append([k * count, bottom, ahead + shift])
        faces.append([k * count + count - 1 - shift, ahead + count - 1, top])
    mesh = trimesh.Trimesh(np.array(vertices), faces, process=False)
    mesh.merge_vertices(digits_vertex=9)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    return mesh


def internal_ridge(
    thread: Thread, turns: float, gap: float, wall_radius: float, crest_gap: float, per_turn: int = 24
) -> list[np.ndarray]:
    """Ridge of a nut for `thread`, (8, 3) corners of every piece: from z = 0, `gap` m thinner on each flank.

    Args:
        wall_radius: where the ridge is rooted.
        crest_gap: m between its crest and the thread's root.
    """
    inner = thread.minor_radius + crest_gap
    halves = {r: max(thread.groove_half_width(r) - gap, 1e-5) for r in (inner, wall_radius)}
    # the groove's middle lies half a pitch above the crest
    pieces = []
    for k in range(round(turns * per_turn)):
        corners = []
        for step in (k, k + 1):
            angle = 2 * np.pi * step / per_turn
            middle = thread.pitch * step / per_turn + thread.pitch / 2
            for r, half in halves.items():
                stretch = 1.0 if r == inner else 1 / np.cos(np.pi / per_turn)
                corners += [[r * stretch * np.cos(angle), r * stretch * np.sin(angle), middle + s * half] for s in (-1, 1)]
        pieces.append(np.array(corners))
    return pieces


M16 = Thread(major_radius=0.008, pitch=0.002, length=0.024)
NUT_ACROSS_FLATS, NUT_HEIGHT, NUT_WALL = 0.024, 0.013, 0.0083  # m; the wall is the ridge's root
NUT_GAP, NUT_CREST_GAP, NUT_TURNS = 1e-4, 2e-4, 2.0
STEEL, GREASED, GREY = 7800.0, 0.15, (0.70, 0.72, 0.75)


def m16_bolt() -> Part:
    """Thread of an M16 bolt, 24 mm, standing up; its frame in the middle of its foot."""
    return Part("bolt", (Solid(external_mesh(M16)),), GREY, density=STEEL, friction=GREASED)


def m16_nut() -> Part:
    """Hexagon nut, 24 mm across flats, two turns of ridge in its lower half; its frame on the axis, in the underside."""

    def hexagon(angles: np.ndarray) -> np.ndarray:
        return NUT_ACROSS_FLATS / 2 / np.cos((angles + np.pi / 6) % (np.pi / 3) - np.pi / 6)

    wedges = ring_of_wedges(12, NUT_WALL, hexagon, 0.0, NUT_HEIGHT)
    ridge = [piece + [0, 0, 0.0015] for piece in internal_ridge(M16, NUT_TURNS, NUT_GAP, NUT_WALL, NUT_CREST_GAP)]
    return Part("nut", (Hulls((*wedges, *ridge)),), GREY, density=STEEL, friction=GREASED)
