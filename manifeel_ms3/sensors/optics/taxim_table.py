"""Calibration tables in Taxim's format, `polycalib.npz` (Si & Yuan 2022, section III), and the compact shader fitted to one.

The table's image is in portrait format: its columns u run along our rows, its rows v against our columns. A pair of bins
(slope m, direction phi) holds, for each channel, the coefficients of (u^2, v^2, u v, u, v, 1) of the colour change. A table
may have any number of bins.
"""

from pathlib import Path

import numpy as np

from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.files import read_npz

from .shader import KNOTS, Shader, fourier_terms, place_terms, slope_terms

MAX_SLOPE = 1.0  # rad: the last of `KNOTS`, beyond which the shader is constant
TABLE_CHANNELS = ("grad_r", "grad_g", "grad_b")
# Measured colour (RGB) of an untouched R1.5 gel at the image's centre and at its corners (u, v) = (-,-) (+,-) (-,+) (+,+);
# the background is the quadratic through them
BACKGROUND_CENTRE = (140.0, 149.0, 134.0)
BACKGROUND_CORNERS = ((107.0, 112.0, 31.0), (93.0, 113.0, 68.0), (106.0, 87.0, 72.0), (102.0, 103.0, 83.0))


def read_table(path: Path) -> np.ndarray:
    """Table (3, bins, bins, 6): channel, slope bin, direction bin, term.

    Raises:
        InvalidFileError: The file is missing or does not have Taxim's format.
    """
    if not Path(path).is_file():
        raise InvalidFileError(f"calibration table {path} does not exist; give a polycalib.npz in Taxim's format")
    stored = read_npz(path, "a calibration table")
    missing = [name for name in TABLE_CHANNELS if name not in stored]
    if missing:
        raise InvalidFileError(f"calibration table {path} lacks {missing}; it must hold {TABLE_CHANNELS}, each (bins, bins, 6)")
    arrays = [stored[name] for name in TABLE_CHANNELS]
    shape = arrays[0].shape
    if len(shape) != 3 or shape[0] != shape[1] or shape[2] != 6 or any(a.shape != shape for a in arrays):
        raise InvalidFileError(
            f"calibration table {path} has arrays of shape {[a.shape for a in arrays]}, not (bins, bins, 6) each"
        )
    return np.stack(arrays)


def portrait_place(r: np.ndarray, c: np.ndarray, image_shape: tuple[int, int]) -> np.ndarray:
    """Table terms (..., 6) = (u^2, v^2, u v, u, v, 1) at normalised places (r, c) of our image."""
    rows, cols = image_shape
    u, v = (r + 1) / 2 * (rows - 1), (1 - c) / 2 * (cols - 1)
    return np.stack([u * u, v * v, u * v, u, v, np.ones_like(u)], axis=-1)


def fit_table(table: np.ndarray, image_shape: tuple[int, int]) -> Shader:
    """Shader fitted by least squares over all bins up to `MAX_SLOPE`.

    The table's own value at zero slope is subtracted first, at every place.

    Args:
        table: Table (3, bins, bins, 6) of `read_table`.
        image_shape: Rows and columns of our image, which is the table's image laid on its side.
    """
    bins = table.shape[1]
    slope = np.arange(bins) * (np.pi / 2 / (bins - 1))
    phi = np.arange(bins) * (2 * np.pi / (bins - 1)) - np.pi + np.pi / (bins - 1)  # middle of the bin
    kept = (slope > 0) & (slope <= MAX_SLOPE)
    flat = table[:, 0, (bins - 1) // 2]  # |grad| = 0 falls into the bin of phi = 0
    change = table[:, kept] - flat[:, None, None]  # (3, S, P, 6), portrait terms
    # a quadratic in (u, v) is one in (r, c): change the terms exactly, on a 3 x 3 grid that determines both
    r, c = (g.flatten() for g in np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij"))
    to_ours = np.linalg.pinv(place_terms(r, c)) @ portrait_place(r, c, image_shape)  # (6, 6)
    change = change @ to_ours.T
    # our direction: dh/du = dh/dr, dh/dv = -dh/dc, so that phi_ours = -phi
    middle = slope[kept] + (slope[1] - slope[0]) / 2
    design = np.einsum("pf,sk->spfk", fourier_terms(-phi), slope_terms(np.tan(middle)))
    design = design.reshape(-1, design.shape[2] * design.shape[3])
    weights = [np.linalg.lstsq(design, change[channel].reshape(len(design), 6), rcond=None)[0] for channel in range(3)]
    weights = np.stack(weights).reshape(3, fourier_terms(phi).shape[-1], len(KNOTS) - 1, 6)
    return Shader(weights, _background())


def _background() -> np.ndarray:
    """Place terms (3, 6) of the quadratic through the five measured colours, with equal curvature along both axes."""
    centre, corners = np.array(BACKGROUND_CENTRE), np.array(BACKGROUND_CORNERS)
    r, c = np.array([-1.0, 1.0, -1.0, 1.0]), np.array([1.0, 1.0, -1.0, -1.0])  # u is our r, v our -c
    linear = [(corners * weight[:, None]).mean(axis=0) for weight in (r, c, r * c)]
    curvature = (corners.mean(axis=0) - centre) / 2
    return np.stack([centre, linear[0], linear[1], curvature, linear[2], curvature], axis=-1)
