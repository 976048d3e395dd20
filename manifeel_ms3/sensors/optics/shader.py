"""The compact shader of a gel's reflective skin: how its colour changes with slope, direction and place.

A channel changes, in grey levels of 255, at the normalised image place (r, c) in [-1, 1]^2 and for a surface gradient of size t
and direction phi, by

    dI = sum_f sum_k sum_q  w[f, k, q]  F_f(phi)  B_k(t)  Q_q(r, c)

with F = (1, cos phi, sin phi, cos 2 phi, sin 2 phi), periodic by construction; hat functions B over `KNOTS`, zero at t = 0, so
that a flat gel has exactly the background's colour; Q = (1, r, c, r^2, r c, c^2). These 210 numbers per channel replace the
86,400 of a look-up table (Taxim, Si & Yuan 2022), without its bins and seams.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.files import atomic_write, read_npz

# Surface gradients |grad h|, m/m, at slopes in rad (chosen: dense where the R1.5's table bends); constant beyond the last
KNOTS = np.tan([0.0, 0.08, 0.16, 0.25, 0.35, 0.5, 0.7, 1.0])
FOURIER_TERMS = 5
PLACE_TERMS = 6


@dataclass
class Shader:
    """Coefficients of a gel's colours, in grey levels of 255."""

    weights: np.ndarray
    """w, (3, 5, 7, 6): channel, Fourier term, knot, place term."""
    background: np.ndarray
    """Colour of the untouched gel, (3, 6): channel, place term."""

    @classmethod
    def load(cls, path: Path) -> "Shader":
        """Read coefficients written by `save`.

        Raises:
            InvalidFileError: The file is missing, or is not a shader file.
        """
        wanted = {"weights": (3, FOURIER_TERMS, len(KNOTS) - 1, PLACE_TERMS), "background": (3, PLACE_TERMS)}
        remedy = "give a file written by `python -m manifeel_ms3.sensors.optics.fit_shader`"
        if not Path(path).is_file():
            raise InvalidFileError(f"optics.calibration={path} does not exist; {remedy}")
        arrays = read_npz(path, "a shader file", list(wanted))
        for name, shape in wanted.items():
            if arrays[name].shape != shape:
                raise InvalidFileError(
                    f"optics.calibration={path}: {name} has shape {arrays[name].shape}, not {shape}; {remedy}"
                )
        return cls(**{name: array.astype(np.float32) for name, array in arrays.items()})

    def save(self, path: Path) -> None:
        """Write the coefficients in float32, compressed.

        Raises:
            FileWriteError: The file cannot be written.
        """
        arrays: dict[str, Any] = dict(weights=self.weights.astype(np.float32), background=self.background.astype(np.float32))
        with atomic_write(path) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **arrays)


def fourier_terms(phi: np.ndarray) -> np.ndarray:
    """Fourier terms F (..., 5) of the gradient's direction, rad."""
    return np.stack([np.ones_like(phi), np.cos(phi), np.sin(phi), np.cos(2 * phi), np.sin(2 * phi)], axis=-1)


def slope_terms(gradient: np.ndarray) -> np.ndarray:
    """Hat functions B (..., 7) of the gradient's size, m/m, without the one at 0."""
    t = np.clip(gradient, 0.0, KNOTS[-1])
    return np.stack([np.interp(t, KNOTS, np.eye(len(KNOTS))[k]) for k in range(1, len(KNOTS))], axis=-1)


def place_terms(r: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Place terms Q (..., 6) at the normalised row r and column c."""
    return np.stack([np.ones_like(r), r, c, r * r, r * c, c * c], axis=-1)
