"""Indenters with closed forms: meshes, and heights above the pad's face."""

import numpy as np
import trimesh

from manifeel_ms3.verification.published_colours import dimples

THREAD_RADIUS, THREAD_PITCH, THREAD_DEPTH = 8e-3, 2e-3, 1.08e-3  # m: M16


def thread_radius(angle: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Radius of a V thread, in m: crests at the full radius, one pitch for each turn."""
    phase = (along / THREAD_PITCH - angle / (2 * np.pi)) % 1.0
    return THREAD_RADIUS - THREAD_DEPTH * np.abs(2 * phase - 1)


def thread_mesh(length: float = 0.020, per_turn: int = 720, per_pitch: int = 64) -> trimesh.Trimesh:
    """Surface of a thread with its axis along y, without end faces; m."""
    angle = np.linspace(0, 2 * np.pi, per_turn, endpoint=False)
    along = np.linspace(-length / 2, length / 2, round(length / THREAD_PITCH * per_pitch) + 1)
    a, y = np.meshgrid(angle, along, indexing="ij")
    r = thread_radius(a, y)
    # a = 0 points to -z, down into the gel
    vertices = np.stack([r * np.sin(a), y, -r * np.cos(a)], axis=-1).reshape(-1, 3)
    return trimesh.Trimesh(vertices, _grid_faces(per_turn, len(along), wrap=True), process=False)


def thread_height(x: np.ndarray, y: np.ndarray, axis_height: float) -> np.ndarray:
    """Height of the thread's lower surface at (x, y), in m into the gel, for an axis at this height above the face."""
    angle = np.linspace(-0.9, 0.9, 20_001)
    out = np.empty_like(x)
    for value in np.unique(y):
        at = y == value
        r = thread_radius(angle, np.full_like(angle, value))
        order = np.argsort(r * np.sin(angle), kind="stable")
        out[at] = np.interp(x[at], (r * np.sin(angle))[order], (r * np.cos(angle))[order]) - axis_height
    return out


def dimple_mesh(half: float = 0.010, step: float = 5e-5) -> trimesh.Trimesh:
    """A dimpled plate that faces the pad (-z), its top at z = 0."""
    line = np.arange(-half, half + step / 2, step)
    x, y = np.meshgrid(line, line, indexing="ij")
    vertices = np.stack([x, y, dimples(x, y)], axis=-1).reshape(-1, 3)
    return trimesh.Trimesh(vertices, _grid_faces(len(line), len(line), wrap=False), process=False)


def _grid_faces(rows: int, cols: int, wrap: bool) -> np.ndarray:
    i, j = np.meshgrid(np.arange(rows if wrap else rows - 1), np.arange(cols - 1), indexing="ij")
    a, b = (i % rows) * cols + j, ((i + 1) % rows) * cols + j
    return np.concatenate([np.stack([a, b + 1, b], -1).reshape(-1, 3), np.stack([a, a + 1, b + 1], -1).reshape(-1, 3)])
