"""The table top of wooden boards: its texture, which is painted here, and its mesh with the texture's coordinates."""

import functools
import hashlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import trimesh
from sapien.render import RenderMaterial, RenderTexture2D

from manifeel_ms3.errors import MachineError
from manifeel_ms3.paths import derived_file

from .looks import SPECULAR

TILE = 0.8
"""Side of the square, in m, that the texture covers; it repeats beyond. Chosen by eye."""
PIXELS = 1024
"""Width and height of the texture, in pixels; a power of 2."""
ROWS = 8
"""Number of rows of boards across a tile; chosen by eye."""
WOOD = (0.68, 0.59, 0.49)
"""Mean colour of the boards, sRGB in [0, 1]; chosen by eye."""
ROUGHNESS = 0.5
"""Roughness of the surface, in [0, 1]; chosen by eye."""


@dataclass(frozen=True)
class BoardsConfig:
    """How the boards are painted; all values are chosen by eye."""

    fine_grain: tuple[float, float] = (60, 1.0)
    """Length and width, in pixels, over which the fine grain is smooth."""
    broad_grain: tuple[float, float] = (250, 9.0)
    """Length and width, in pixels, over which the growth rings are smooth."""
    end_jitter: int = 100
    """Largest shift, in pixels, of one end of a board from half a tile beyond the other end."""
    ring_turns: float = 1.3
    """Number of growth rings for one standard deviation of the broad grain."""
    ring_phases: float = 3.0
    """Number of rings by which those of one board may be shifted against those of another."""
    board_contrast: float = 0.055
    """Standard deviation of the boards' brightness, as a share of the mean."""
    ring_contrast: float = 0.035
    """Amplitude of the rings' brightness, as a share of the mean."""
    grain_contrast: float = 0.035
    """Standard deviation of the fine grain's brightness, as a share of the mean."""
    channel_powers: tuple[float, float, float] = (0.8, 1.0, 1.25)
    """Powers of the brightness in red, green and blue: dark wood is redder."""
    seam_darkness: float = 0.35
    """Share by which the seams between the boards are darker."""


BOARDS = BoardsConfig()


def wood() -> RenderMaterial:
    """Make the material of the table, which works only where there is a renderer."""
    material = RenderMaterial(roughness=ROUGHNESS, specular=SPECULAR)
    material.base_color_texture = wood_texture(0)
    return material


@functools.cache
def wood_texture(seed: int) -> RenderTexture2D:
    """Texture of the table, painted once and kept among the derived assets; seed 0 is the usual one.

    Raises:
        MachineError: The picture that was kept is damaged, or there is no place to keep it.
    """
    picture = cv2.imread(str(_painted(seed)))
    if picture is None:
        raise MachineError(f"{_painted(seed)} is damaged; delete it, and it is made anew")
    pixels = cv2.cvtColor(picture, cv2.COLOR_BGR2RGBA)
    return RenderTexture2D(pixels, "R8G8B8A8Unorm", mipmap_levels=int(np.log2(PIXELS)) + 1, srgb=True)


def _painted(seed: int) -> Path:
    """Path of a picture of the boards; its name is a hash of how they are painted."""
    how = hashlib.sha256(repr((BOARDS, WOOD, ROWS, PIXELS, seed)).encode()).hexdigest()[:16]
    return derived_file(f"parts/boards-{how}.png", lambda: cv2.imencode(".png", boards(seed)[..., ::-1])[1].tobytes())


def boards(seed: int) -> np.ndarray:
    """Image uint8 (PIXELS, PIXELS, 3) of boards along its rows; its opposite sides fit together."""
    rng = np.random.default_rng(seed)
    fine, broad = _streaks(rng, *BOARDS.fine_grain), _streaks(rng, *BOARDS.broad_grain)
    brightness = np.empty((PIXELS, PIXELS))
    seams = np.zeros((PIXELS, PIXELS))
    height = PIXELS // ROWS
    for row in range(ROWS):
        rows = slice(row * height, (row + 1) * height)
        jitter = BOARDS.end_jitter
        ends = (rng.integers(PIXELS) + np.array([0, PIXELS // 2 + rng.integers(-jitter, jitter)])) % PIXELS
        for start, stop in ((ends[0], ends[1]), (ends[1], ends[0])):
            columns = np.arange(start, stop if stop > start else stop + PIXELS) % PIXELS
            turns = BOARDS.ring_turns * np.roll(broad, rng.integers(PIXELS), 1)[rows, columns]
            rings = np.sin(2 * np.pi * (turns + BOARDS.ring_phases * rng.random()))
            grain = np.roll(fine, rng.integers(PIXELS), 1)[rows, columns]
            board = 1 + BOARDS.board_contrast * rng.standard_normal()
            brightness[rows, columns] = board + BOARDS.ring_contrast * rings + BOARDS.grain_contrast * grain
            seams[rows, columns[0]] = 1
        seams[row * height] = 1
    tint = brightness[..., None] ** np.array(BOARDS.channel_powers)
    image = np.array(WOOD) * tint * (1 - BOARDS.seam_darkness * seams[..., None])
    return (255 * image.clip(0, 1)).astype(np.uint8)


def _streaks(rng: np.random.Generator, length: float, width: float) -> np.ndarray:
    """Periodic noise (PIXELS, PIXELS) of unit variance, smooth over a length along rows and a width across, in pixels."""
    frequency = np.fft.fftfreq(PIXELS)
    smooth = np.exp(-2 * np.pi**2 * ((width * frequency[:, None]) ** 2 + (length * frequency[None]) ** 2))
    noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal((PIXELS, PIXELS))) * smooth).real
    return noise / noise.std()


def table_mesh(size: tuple[float, float, float]) -> Path:
    """Path of a file with a box about the origin, with the coordinates of its texture.

    Args:
        size: Size of the box, in m.
    """
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
