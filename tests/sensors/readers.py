"""Photometric stereo: recovers a height map from a TacRGB image."""

import numpy as np
from scipy.fft import dctn, idctn

from manifeel_ms3.sensors.optics.shader import Shader, fourier_terms, place_terms, slope_terms
from manifeel_ms3.verification.published_colours import places


def photometric_stereo(picture: np.ndarray, shader: Shader, pixel_size: float, step: int = 2) -> np.ndarray:
    """Height map (H / step, W / step), m, from a picture: the gradient whose colour is nearest at every pixel, integrated."""
    picture = picture[::step, ::step].astype(float)
    rows, cols = picture.shape[:2]
    place = place_terms(*(p.ravel() for p in places((rows * step, cols * step))))
    place = place.reshape(rows * step, cols * step, -1)[::step, ::step].reshape(-1, 6)
    size, phi = np.r_[0.0, np.geomspace(0.004, 0.8, 48)], np.linspace(-np.pi, np.pi, 72, endpoint=False)
    known = np.einsum("cfkq,pf,tk->tpcq", shader.weights, fourier_terms(phi), slope_terms(size)).reshape(-1, 3, 6)
    gradient = np.stack([np.outer(size, np.cos(phi)), np.outer(size, np.sin(phi))], axis=-1).reshape(-1, 2)
    change = picture.reshape(-1, 3) - place @ shader.background.T
    found = np.empty((len(change), 2))
    for start in range(0, len(change), 500):
        part = slice(start, start + 500)
        colours = np.einsum("ncq,mq->mnc", known, place[part])
        found[part] = gradient[((colours - change[part, None]) ** 2).sum(-1).argmin(1)]
    return _integrate(found.reshape(rows, cols, 2), step * pixel_size)


def _integrate(gradient: np.ndarray, pitch: float) -> np.ndarray:
    """Poisson's equation with free rims by cosine transforms; the rim's median height is zero."""
    rows, cols = gradient.shape[:2]
    source = np.zeros((rows, cols))
    along_rows, along_cols = (gradient[1:, :, 0] + gradient[:-1, :, 0]) / 2, (gradient[:, 1:, 1] + gradient[:, :-1, 1]) / 2
    source[:-1] += along_rows
    source[1:] -= along_rows
    source[:, :-1] += along_cols
    source[:, 1:] -= along_cols
    wave = [2 * np.cos(np.pi * np.arange(n) / n) - 2 for n in (rows, cols)]
    laplacian = wave[0][:, None] + wave[1][None]
    laplacian[0, 0] = 1.0
    height = idctn(dctn(source * pitch) / laplacian)
    return height - np.median(np.r_[height[0], height[-1], height[:, 0], height[:, -1]])
