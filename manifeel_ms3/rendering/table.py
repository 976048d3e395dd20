"""The table top of wooden boards: its texture, painted here, and its mesh with the texture's coordinates."""

import functools
from pathlib import Path

import numpy as np
import trimesh
from sapien.render import RenderMaterial, RenderTexture2D

from manifeel_ms3.paths import derived_file

TILE = 0.8
"""Side of the square, in m, that the texture covers; it repeats beyond."""
PIXELS = 1024
ROWS = 8
"""Number of rows of boards across a tile."""
WOOD = (0.68, 0.59, 0.49)
"""Mean colour of the boards, sRGB in [0, 1]."""
ROUGHNESS = 0.5


def wood() -> RenderMaterial:
    """Surface of the table; only where there is a renderer."""
    material = RenderMaterial(roughness=ROUGHNESS, specular=0.5)
    material.base_color_texture = wood_texture(0)
    return material


@functools.cache
def wood_texture(seed: int) -> RenderTexture2D:
    """Texture of the table, painted once in a process; seed 0 is the usual one."""
    pixels = np.dstack([boards(seed), np.full((PIXELS, PIXELS), 255, np.uint8)])
    return RenderTexture2D(pixels, "R8G8B8A8Unorm", mipmap_levels=int(np.log2(PIXELS)) + 1, srgb=True)


def boards(seed: int) -> np.ndarray:
    """Image uint8 (PIXELS, PIXELS, 3) of boards along its rows, which continues on the opposite side."""
    rng = np.random.default_rng(seed)
    fine, broad = _streaks(rng, 60, 1.0), _streaks(rng, 250, 9.0)
    brightness = np.empty((PIXELS, PIXELS))
    seams = np.zeros((PIXELS, PIXELS))
    height = PIXELS // ROWS
    for row in range(ROWS):
        rows = slice(row * height, (row + 1) * height)
        ends = (rng.integers(PIXELS) + np.array([0, PIXELS // 2 + rng.integers(-100, 100)])) % PIXELS
        for start, stop in ((ends[0], ends[1]), (ends[1], ends[0])):
            columns = np.arange(start, stop if stop > start else stop + PIXELS) % PIXELS
            rings = np.sin(2 * np.pi * (1.3 * np.roll(broad, rng.integers(PIXELS), 1)[rows, columns] + 3 * rng.random()))
            grain = np.roll(fine, rng.integers(PIXELS), 1)[rows, columns]
            brightness[rows, columns] = 1 + 0.055 * rng.standard_normal() + 0.035 * rings + 0.035 * grain
            seams[rows, columns[0]] = 1
        seams[row * height] = 1
    image = np.array(WOOD) * brightness[..., None] ** np.array([0.8, 1.0, 1.25]) * (1 - 0.35 * seams[..., None])
    return (255 * image.clip(0, 1)).astype(np.uint8)


def _streaks(rng: np.random.Generator, length: float, width: float) -> np.ndarray:
    """Periodic noise (PIXELS, PIXELS) of unit variance, smooth over a length along rows and a width across, in pixels."""
    frequency = np.fft.fftfreq(PIXELS)
    smooth = np.exp(-2 * np.pi**2 * ((width * frequency[:, None]) ** 2 + (length * frequency[None]) ** 2))
    noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal((PIXELS, PIXELS))) * smooth).real
    return noise / noise.std()


def table_mesh(size: tuple[float, float, float]) -> Path:
    """File with a box of this size, in m, about the origin, whose texture's coordinates are lengths on each face."""
    return derived_file(f"parts/table-{'x'.join(f'{side:g}' for side in size)}-{TILE:g}.obj", lambda: _box_obj(size))


def _box_obj(size: tuple[float, float, float]) -> str:
    box = trimesh.creation.box(size)
    box.unmerge_vertices()
    normals = np.repeat(box.face_normals, 3, axis=0)
    axes = [[k for k in range(3) if k != axis] for axis in np.abs(normals).argmax(axis=1)]
    places = np.take_along_axis(box.vertices, np.array(axes), axis=1) / TILE
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in box.vertices]
    lines += [f"vt {u:.9f} {v:.9f}" for u, v in places]
    lines += [f"vn {x:.0f} {y:.0f} {z:.0f}" for x, y, z in normals]
    lines += ["f " + " ".join(f"{k}/{k}/{k}" for k in face) for face in box.faces + 1]
    return "\n".join(lines)
