"""Two ways to read optics from outside: a published table, and photometric stereo."""

import numpy as np
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter

from manifeel_ms3.sensors.optics.shader import Shader, fourier_terms, place_terms, slope_terms
from manifeel_ms3.sensors.optics.taxim_table import portrait_place


def gradients(surface: np.ndarray, pixel_size: float) -> tuple[np.ndarray, np.ndarray]:
    """Central differences along rows and columns, m/m."""
    padded = np.pad(surface, 1, mode="edge")
    return (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2 * pixel_size), (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * pixel_size)


def _places(shape: tuple[int, int]) -> list[np.ndarray]:
    return np.meshgrid(np.linspace(-1, 1, shape[0]), np.linspace(-1, 1, shape[1]), indexing="ij")


def table_change(table: np.ndarray, surface: np.ndarray, pixel_size: float) -> np.ndarray:
    """Colour change (H, W, 3) of a surface (H, W), m, by a table in Taxim's format, interpolated between its bins' middles."""
    along_rows, along_cols = gradients(surface, pixel_size)
    slope, phi = np.arctan(np.hypot(along_rows, along_cols)), np.arctan2(-along_cols, along_rows)
    last = table.shape[1] - 1
    change = table - table[:, :1, last // 2 + 1 : last // 2 + 2]
    change[:, 0] = 0.0
    u = np.clip(slope / (np.pi / 2 / last) - 0.5, 0, last - 1e-3)
    v = ((phi + np.pi) / (2 * np.pi / last) - 0.5) % last
    i, j = u.astype(int), v.astype(int)
    terms = portrait_place(*_places(surface.shape), surface.shape)
    total = np.zeros((*surface.shape, 3))
    for rows, row_share in ((i, 1 - (u - i)), (i + 1, u - i)):
        for cols, col_share in ((j, 1 - (v - j)), ((j + 1) % last, v - j)):
            total += (row_share * col_share)[..., None] * np.einsum("khwq,hwq->hwk", change[:, rows, cols], terms)
    return total


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Structural similarity (Wang 2004) of two pictures (H, W, 3), Gaussian windows of 1.5 pixels, the second's range."""
    span = b.max() - b.min()
    c1, c2 = (0.01 * span) ** 2, (0.03 * span) ** 2

    def mean(picture: np.ndarray) -> np.ndarray:
        return gaussian_filter(picture, 1.5, axes=(0, 1))

    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    return float((((2 * ma * mb + c1) * (2 * cov + c2)) / ((ma**2 + mb**2 + c1) * (va + vb + c2))).mean())


def photometric_stereo(picture: np.ndarray, shader: Shader, pixel_size: float, step: int = 2) -> np.ndarray:
    """Height map (H / step, W / step), m, from a picture: the gradient whose colour is nearest at every pixel, integrated."""
    picture = picture[::step, ::step].astype(float)
    rows, cols = picture.shape[:2]
    place = place_terms(*(p.ravel() for p in _places((rows * step, cols * step))))
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
