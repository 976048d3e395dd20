"""Similarity of a sensor's images with those of the published calibration of the GelSight R1.5, read with interpolation."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from manifeel_ms3.paths import data_dir
from manifeel_ms3.sensors.config import TactileSensorConfig
from manifeel_ms3.sensors.mechanics.contact import ContactGrid
from manifeel_ms3.sensors.optics.tacrgb import Optics
from manifeel_ms3.sensors.optics.taxim_table import portrait_place
from manifeel_ms3.sensors.touch_model import CONTACT_CELL

CALIBRATION = data_dir() / "gelsight_r15_polycalib_subset.npz"
"""The slope bins up to 1.2 rad of Taxim's table of a GelSight R1.5 (NOTICE), in int16."""
DIMPLE_PITCH, DIMPLE_RADIUS, DIMPLE_DEPTH = 3.6e-3, 1.7e-3, 2.5e-4
"""Distance of neighbouring dimples of a golf ball, radius of a dimple's rim, and its depth, in m: typical values."""
SSIM_WINDOW = 1.5
"""Standard deviation of the Gaussian window of the structural similarity, in pixels (Wang et al. 2004)."""
SSIM_K1, SSIM_K2 = 0.01, 0.03
"""Constants K1 and K2 of the structural similarity, as shares of the range (Wang et al. 2004)."""
LAST_BIN_MARGIN = 1e-3
"""Distance, in bins, that a slope keeps from the table's last bin, which has no next one to interpolate to."""


@dataclass(frozen=True)
class PressedShapes:
    """Sizes of the shapes that are pressed, in m; chosen by hand."""

    round_radius: float = 0.004
    """Radius of the ball and the rod."""
    ball_depth: float = 6e-4
    """Depth of the ball."""
    rod_depth: float = 5e-4
    """Depth of the rod."""
    rod_half_length: float = 0.008
    """Half length of the rod."""
    plate_half_size: tuple[float, float] = (0.004, 0.005)
    """Half sizes of the tilted plate along rows and columns."""
    plate_depth: float = 4e-4
    """Depth of the tilted plate at its middle."""
    plate_slope: float = 0.02
    """Slope of the tilted plate, m/m."""
    wedge_depth: float = 5e-4
    """Depth of the wedge's edge."""
    wedge_slope: float = 0.5
    """Slope of the wedge's two sides, m/m."""
    half_length: float = 0.007
    """Half length of the wedge, and half size of the plate with dimples."""
    dimpled_depth: float = 4e-4
    """Depth of the plate with dimples."""
    apart: float = -1.0
    """Height beside a shape, where it does not touch: any negative value."""


PRESSED = PressedShapes()


def published_table() -> np.ndarray:
    """The published table (3, bins, bins, 6) in Taxim's format; its slope bins beyond 1.2 rad are zero."""
    with np.load(CALIBRATION) as stored:
        kept, bins = stored["coefficients"] * stored["scale"], int(stored["bins"])
    table = np.zeros((3, bins, *kept.shape[2:]))
    table[:, : kept.shape[1]] = kept
    return table


def gradients(surface: np.ndarray, pixel_size: float) -> tuple[np.ndarray, np.ndarray]:
    """Central differences (H, W) along rows and columns of a surface (H, W), m/m."""
    padded = np.pad(surface, 1, mode="edge")
    return (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2 * pixel_size), (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * pixel_size)


def places(shape: tuple[int, int]) -> list[np.ndarray]:
    """Normalised rows and columns (H, W) of an image, in [-1, 1]."""
    return list(np.meshgrid(*(np.linspace(-1, 1, count) for count in shape), indexing="ij"))


def table_change(table: np.ndarray, surface: np.ndarray, pixel_size: float) -> np.ndarray:
    """Colour change (H, W, 3) of a surface (H, W), m, by a table in Taxim's format, interpolated between its bins' middles."""
    along_rows, along_cols = gradients(surface, pixel_size)
    slope, phi = np.arctan(np.hypot(along_rows, along_cols)), np.arctan2(-along_cols, along_rows)
    last = table.shape[1] - 1
    change = table - table[:, :1, last // 2 + 1 : last // 2 + 2]
    change[:, 0] = 0.0
    u = np.clip(slope / (np.pi / 2 / last) - 0.5, 0, last - LAST_BIN_MARGIN)
    v = ((phi + np.pi) / (2 * np.pi / last) - 0.5) % last
    i, j = u.astype(int), v.astype(int)
    shape = (surface.shape[0], surface.shape[1])
    rows_at, cols_at = places(shape)
    terms = portrait_place(rows_at, cols_at, shape)
    total = np.zeros((*shape, 3))
    for rows, row_share in ((i, 1 - (u - i)), (i + 1, u - i)):
        for cols, col_share in ((j, 1 - (v - j)), ((j + 1) % last, v - j)):
            total += (row_share * col_share)[..., None] * np.einsum("khwq,hwq->hwk", change[:, rows, cols], terms)
    return total


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004) of two images (H, W, 3), with the range of the second."""
    span = b.max() - b.min()
    c1, c2 = (SSIM_K1 * span) ** 2, (SSIM_K2 * span) ** 2

    def mean(image: np.ndarray) -> np.ndarray:
        return gaussian_filter(image, SSIM_WINDOW, axes=(0, 1))

    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    return float((((2 * ma * mb + c1) * (2 * cov + c2)) / ((ma**2 + mb**2 + c1) * (va + vb + c2))).mean())


def dimples(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Depth of spherical dimples on a square lattice, m, at points x and y, m."""
    u, v = (p - np.round(p / DIMPLE_PITCH) * DIMPLE_PITCH for p in (x, y))
    ball = (DIMPLE_RADIUS**2 + DIMPLE_DEPTH**2) / (2 * DIMPLE_DEPTH)
    inside = u * u + v * v < DIMPLE_RADIUS**2
    return np.where(inside, np.sqrt(ball**2 - np.minimum(u * u + v * v, DIMPLE_RADIUS**2)) - ball + DIMPLE_DEPTH, 0.0)


def pressed_shapes(config: TactileSensorConfig) -> dict[str, np.ndarray]:
    """Heights (H, W), m, of shapes over the untouched face, into it."""
    x, y = np.meshgrid(*((np.arange(n) - (n - 1) / 2) * config.pixel_size for n in config.image_shape), indexing="ij")
    p, far_x, far_y = PRESSED, np.abs(x), np.abs(y)
    radius, on_plate = p.round_radius, (far_x < p.plate_half_size[0]) & (far_y < p.plate_half_size[1])
    on_dimples = (far_x < p.half_length) & (far_y < p.half_length)
    rod = np.sqrt(np.maximum(radius**2 - x**2, 0)) - radius + p.rod_depth
    return {
        "ball": np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0)) - radius + p.ball_depth,
        "rod": np.where(far_y < p.rod_half_length, rod, p.apart),
        "tilted plate": np.where(on_plate, p.plate_depth + p.plate_slope * x, p.apart),
        "wedge": np.where(far_y < p.half_length, p.wedge_depth - p.wedge_slope * far_x, p.apart),
        "dimples": np.where(on_dimples, p.dimpled_depth - dimples(x, y), p.apart),
    }


def change_images(optics: Optics, height: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Changes (H, W, 3) from the untouched gel's image under a shape: the sensor's, and that of a published table."""
    surface = optics.surface(torch.as_tensor(height.clip(min=0), dtype=torch.float32)[None])
    background = optics.levels.cpu().numpy()
    change = optics.shade(surface)[0].cpu().numpy() - background
    published = table_change(table, surface[0].double().cpu().numpy(), optics.config.pixel_size)
    return change, (background + published).clip(0, 255) - background


def worst_similarity(config: TactileSensorConfig) -> float:
    """Smallest structural similarity, over the shapes, of the sensor's change images with the published table's."""
    cpu = torch.device("cpu")
    optics = Optics(config, ContactGrid.covering(config.gel.size, CONTACT_CELL, cpu), 1, cpu)
    table = published_table()
    return float(np.min([ssim(*change_images(optics, height, table)) for height in pressed_shapes(config).values()]))
