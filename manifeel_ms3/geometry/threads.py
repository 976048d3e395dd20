"""Threads that turn by contact. The fixed part has a triangle mesh as its thread, the held part a row of convex pieces.

In the engine, triangle meshes collide with convex shapes only, and only fixed bodies can have them. All threads are
right-handed.
"""

from dataclasses import dataclass

import numpy as np
import trimesh

FLANK = np.tan(np.deg2rad(30.0))
"""Slope of a flank: half of the thread angle of 60 degrees (ISO 68-1)."""
BOLT_COLUMNS, BORE_COLUMNS = 32, 48
"""Numbers of columns of vertices around the mesh of an external thread, and of an internal one. Set once; not tuned."""
MERGED_DIGITS = 9
"""Decimals, in m, to which vertices must agree to be merged: a nanometre, below which only rounding differs."""


@dataclass(frozen=True)
class Thread:
    """Outer surface of a thread about z: a periodic profile of its radius, which winds along a helix. Lengths are in m."""

    pitch: float
    """Height of one turn."""
    profile: tuple[tuple[float, float], ...]
    """Points (height, radius) along one pitch, joined by straight lines; the crest's middle is at height 0."""

    @property
    def major_radius(self) -> float:
        """Radius of the crest."""
        return max(radius for _, radius in self.profile)

    @property
    def minor_radius(self) -> float:
        """Radius of the root."""
        return min(radius for _, radius in self.profile)

    def wider(self, gap: float) -> "Thread":
        """Bore that this thread runs in: the same thread with its surface `gap`, in m, further out."""
        return Thread(self.pitch, tuple((height, radius + gap) for height, radius in self.profile))


def iso_metric(major_radius: float, pitch: float) -> Thread:
    """ISO metric thread (ISO 68-1): 60 degrees, crest flat of an eighth of the pitch, root flat of a quarter.

    Args:
        major_radius: Radius of the crest, in m.
        pitch: Height of one turn, in m.
    """
    minor = major_radius - (0.5 - 1 / 16 - 1 / 8) * pitch / FLANK
    places = np.array([-1 / 16, 1 / 16, 6 / 16, 10 / 16]) * pitch
    return Thread(pitch, tuple(zip(places, (major_radius, major_radius, minor, minor), strict=True)))


def edison(major_radius: float, pitch: float, arc: float, points: int = 4) -> Thread:
    """Edison screw (IEC 60061-1): crest and root are arcs of one radius, tangent to each other.

    Args:
        major_radius: Radius of the crest, in m.
        pitch: Height of one turn, in m.
        arc: Radius of the arcs, in m.
        points: Number of straight pieces of each arc.
    """
    drop = 2 * arc - np.sqrt(4 * arc**2 - pitch**2 / 4)  # from crest to root
    height = np.linspace(-pitch / 4, pitch / 4, points + 1)
    sag = arc - np.sqrt(arc**2 - height**2)
    crest = zip(height, major_radius - sag, strict=True)
    root = zip(height + pitch / 2, major_radius - drop + sag, strict=True)
    return Thread(pitch, (*crest, *list(root)[1:-1]))


def external_mesh(thread: Thread, length: float, tip_radius: float) -> trimesh.Trimesh:
    """Closed surface of an external thread from z = 0 to `length`, its crest at z = 0 at angle 0.

    Its top is chamfered by 45 degrees.

    Args:
        thread: The thread.
        length: Length along z, in m.
        tip_radius: Radius of the flat end that the chamfer leaves, in m.
    """
    rim = _helix(thread, length, BOLT_COLUMNS)
    chamfer = tip_radius + length - rim[..., 1]
    rim[..., 0] = np.minimum(rim[..., 0], np.maximum(chamfer, tip_radius))
    vertices, faces = _skin(rim, len(thread.profile))
    count = rim.shape[1]
    bottom, top = len(vertices), len(vertices) + 1
    for k in range(BOLT_COLUMNS):
        ahead = (k + 1) % BOLT_COLUMNS * count
        faces += [[k * count, bottom, ahead], [(k + 1) * count - 1, ahead + count - 1, top]]
    return _clean(np.r_[vertices, [[0, 0, 0], [0, 0, length]]], faces)


def internal_mesh(thread: Thread, length: float, mouth_radius: float) -> trimesh.Trimesh:
    """Surface of a bore with this thread from z = 0 to `length`, facing its axis; it is open at its ends and has no back.

    Its mouth, at the top, is chamfered by 45 degrees.

    Args:
        thread: The thread.
        length: Length along z, in m.
        mouth_radius: Radius of the mouth, in m.
    """
    rim = _helix(thread, length, BORE_COLUMNS)
    rim[..., 0] = np.maximum(rim[..., 0], mouth_radius - (length - rim[..., 1]))
    vertices, faces = _skin(rim, len(thread.profile))
    return _clean(vertices, np.fliplr(faces))


def _helix(thread: Thread, length: float, per_turn: int) -> np.ndarray:
    """Columns (per_turn, n, 2) of (radius, height) of the surface, clipped at both ends."""
    heights, radii = np.array(thread.profile).T
    turns = np.arange(-2, int(np.ceil(length / thread.pitch)) + 1)
    u = (turns[:, None] * thread.pitch + heights).ravel()
    z = np.clip(u + thread.pitch * np.arange(per_turn)[:, None] / per_turn, 0.0, length)
    return np.stack([np.broadcast_to(np.tile(radii, len(turns)), z.shape), z], axis=-1)


def _skin(rim: np.ndarray, per_pitch: int) -> tuple[np.ndarray, list[list[int]]]:
    """Vertices and faces between columns; after one turn, a column meets the first one a pitch further up."""
    per_turn, count, _ = rim.shape
    angle = 2 * np.pi * np.arange(per_turn)[:, None] / per_turn
    vertices = np.stack([rim[..., 0] * np.cos(angle), rim[..., 0] * np.sin(angle), rim[..., 1]], axis=-1).reshape(-1, 3)
    faces = []
    for k in range(per_turn):
        ahead, shift = ((k + 1) * count, 0) if k + 1 < per_turn else (0, per_pitch)
        for j in range(count - 1 - shift):
            a, b, c, d = k * count + j, ahead + j + shift, ahead + j + shift + 1, k * count + j + 1
            faces += [[a, b, c], [a, c, d]]
    return vertices, faces


def _clean(vertices: np.ndarray, faces) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(digits_vertex=MERGED_DIGITS)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    return mesh


def ridge(section: np.ndarray, pitch: float, turns: float, per_turn: int, lead_in: float = 0.0) -> list[np.ndarray]:
    """Points (2 m, 3), in m, of each convex piece of a right-handed ridge that winds up from z = 0.

    Args:
        section: Corners (m, 2) of its cross-section, (radius, height), in m.
        pitch: Height of one turn, in m.
        turns: Number of turns.
        per_turn: Number of pieces of one turn.
        lead_in: Number of turns over which the ridge rises from the smallest radius of its cross-section.
    """
    foot = section[:, 0].min()

    def at(step: int) -> np.ndarray:
        angle, (radius, height) = 2 * np.pi * step / per_turn, section.T
        radius = foot + (radius - foot) * (min(step / (lead_in * per_turn), 1.0) if lead_in else 1.0)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), height + pitch * step / per_turn], axis=1)

    first = 1 if lead_in else 0  # the very beginning has no height
    return [np.concatenate([at(k), at(k + 1)]) for k in range(first, round(turns * per_turn))]
