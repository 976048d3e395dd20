"""The compact shader of a gel's reflective skin: how its colour changes with slope, direction and place.

Change of a channel, in grey levels of 255, at the normalised image place (r, c) in [-1, 1]^2 and surface gradient of size t and
direction phi:

    dI = sum_f sum_k sum_q  w[f, k, q]  F_f(phi)  B_k(t)  Q_q(r, c)

with F = (1, cos phi, sin phi, cos 2 phi, sin 2 phi), periodic by construction; B hat functions over `KNOTS`, zero at t = 0, so
that a flat gel is the background exactly; Q = (1, r, c, r^2, r c, c^2). 210 numbers a channel hold what a look-up table holds
in 86,400 (Taxim, Si & Yuan 2022), without its bins and seams.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

KNOTS = np.tan([0.0, 0.08, 0.16, 0.25, 0.35, 0.5, 0.7, 1.0])  # surface gradient |grad h|, m/m; beyond the last: constant
FOURIER_TERMS = 5
PLACE_TERMS = 6


@dataclass
class Shader:
    """`weights` (3, 5, 7, 6): channel, Fourier term, knot, place term. `background` (3, 6): untouched gel, place terms."""

    weights: np.ndarray
    background: np.ndarray

    @classmethod
    def load(cls, path: Path) -> "Shader":
        """Read coefficients written by `save`.

        Raises:
            ValueError: the file is missing, or not a shader file.
        """
        wanted = {"weights": (3, FOURIER_TERMS, len(KNOTS) - 1, PLACE_TERMS), "background": (3, PLACE_TERMS)}
        remedy = "give a file written by `python -m manifeel_ms3.sensors.optics.fit_shader`"
        if not Path(path).is_file():
            raise ValueError(f"optics.calibration={path} does not exist; {remedy}")
        try:
            with np.load(path) as stored:
                arrays = {name: stored[name].astype(np.float32) for name in wanted}
        except (KeyError, OSError, ValueError) as error:
            raise ValueError(f"optics.calibration={path} is not a shader file ({error}); {remedy}") from error
        for name, shape in wanted.items():
            if arrays[name].shape != shape:
                raise ValueError(f"optics.calibration={path}: {name} has shape {arrays[name].shape}, not {shape}; {remedy}")
        return cls(**arrays)

    def save(self, path: Path) -> None:
        np.savez_compressed(path, weights=self.weights.astype(np.float32), background=self.background.astype(np.float32))


def fourier_terms(phi: np.ndarray) -> np.ndarray:
    """(..., 5)"""
    return np.stack([np.ones_like(phi), np.cos(phi), np.sin(phi), np.cos(2 * phi), np.sin(2 * phi)], axis=-1)


def slope_terms(gradient: np.ndarray) -> np.ndarray:
    """(..., 7) hat functions of the gradient's size, without the one at 0"""
    t = np.clip(gradient, 0.0, KNOTS[-1])
    return np.stack([np.interp(t, KNOTS, np.eye(len(KNOTS))[k]) for k in range(1, len(KNOTS))], axis=-1)


def place_terms(r: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(..., 6)"""
    return np.stack([np.ones_like(r), r, c, r * r, r * c, c * c], axis=-1)
