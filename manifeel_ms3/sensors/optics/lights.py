"""Colours of a gel from the places of its lamps, for a sensor that has no published calibration.

A point of the skin with the unit normal n, seen from inside, at the distance r from a lamp in the direction l, shows the level

    I = e sum_k  a_k  max(0, n . l_k) / r_k^2

of each channel: a matt skin under small lamps, without reflections between gel and housing. The exposure e of a channel
does not follow from the lamps: it is set so that the untouched gel has the configured mean level. The compact shader is fitted
to these levels, so that everything after it is the same for all sensors.
"""

import numpy as np

from manifeel_ms3.sensors.config import GelConfig, LightsConfig

from .shader import FOURIER_TERMS, KNOTS, PLACE_TERMS, Shader, fourier_terms, place_terms, slope_terms

PLACES = 9  # places along each side of the image at which the levels are computed (chosen; the fit has 6 terms over them)
GRADIENT_STEP = 1e-6  # m: half of the step of the central differences of the face's depth
DIRECTIONS = 16  # directions of the gradient (chosen; the fit has 5 terms over them)


def lamp_shader(
    lights: LightsConfig, curvature: tuple[float, float], image_shape: tuple[int, int], pixel_size: float
) -> Shader:
    """Shader of a gel under lamps.

    Args:
        lights: The lamps.
        curvature: Curvature of the untouched face across and along the finger, 1/m.
        image_shape: Rows and columns of the image.
        pixel_size: Size of a pixel on the gel's face, m.
    """
    gel = GelConfig(curvature=curvature)
    r, c = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-1, 1, PLACES)] * 2, indexing="ij"))
    x, y = ((n - 1) / 2 * pixel_size * place for n, place in zip(image_shape, (r, c), strict=True))
    place = place_terms(r, c)  # (P, 6)
    untouched = _levels(lights, gel, x, y, np.zeros((1, 2)))[:, 0]  # (P, 3)
    mean = untouched.mean(0)
    exposure = np.divide(lights.level, mean, out=np.zeros(3), where=mean > 0)
    phi = np.linspace(-np.pi, np.pi, DIRECTIONS, endpoint=False)
    steps = np.stack([np.cos(phi), np.sin(phi)], axis=-1)[:, None] * KNOTS[1:, None]  # (D, K, 2)
    change = exposure * (_levels(lights, gel, x, y, steps.reshape(-1, 2)) - untouched[:, None])  # (P, D K, 3)
    terms = np.einsum("df,kj->dkfj", fourier_terms(phi), slope_terms(KNOTS[1:])).reshape(len(steps) * len(KNOTS[1:]), -1)
    # least squares over places and slopes, one after the other, which is exact for their outer product
    over_places = np.linalg.lstsq(place, change.reshape(len(x), -1), rcond=None)[0].reshape(PLACE_TERMS, len(terms), 3)
    weights = np.linalg.lstsq(terms, over_places.transpose(1, 0, 2).reshape(len(terms), -1), rcond=None)[0]
    weights = weights.reshape(FOURIER_TERMS, len(KNOTS) - 1, PLACE_TERMS, 3).transpose(3, 0, 1, 2)
    background = np.linalg.lstsq(place, exposure * untouched, rcond=None)[0].T
    return Shader(weights.astype(np.float32), background.astype(np.float32))


def _levels(lights: LightsConfig, gel: GelConfig, x: np.ndarray, y: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Irradiance (P, S, 3) at P places of the untouched face whose gradient, into the gel, is increased by S steps (S, 2)."""
    depth = gel.sag(x, y)
    h = GRADIENT_STEP
    own = np.stack([gel.sag(x + h, y) - gel.sag(x - h, y), gel.sag(x, y + h) - gel.sag(x, y - h)], axis=-1) / (2 * h)
    gradient = own[:, None] + steps  # (P, S, 2)
    # the skin lies at z = -depth; its normal towards the lamps, which are behind it, points to -z
    normal = np.concatenate([-gradient, -np.ones((*gradient.shape[:2], 1))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    at = np.stack([x, y, -depth], axis=-1)
    level = np.zeros((*gradient.shape[:2], 3))
    for lamp in lights.lamps:
        ray = np.array(lamp.position) - at
        distance = np.linalg.norm(ray, axis=-1)
        facing = np.einsum("psk,pk->ps", normal, ray / distance[:, None]).clip(min=0.0)
        level += (facing / distance[:, None] ** 2)[..., None] * np.array(lamp.colour)
    return level
