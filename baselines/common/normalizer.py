"""Scaling of a network's inputs and outputs to [-1, 1] by their ranges in the demonstrations."""

import torch
import torch.nn as nn

MIN_RANGE = 1e-3
"""Smallest half range that is divided by; values that hardly vary are shifted but not magnified."""


class Normalizer(nn.Module):
    """Affine map of the data's range to [-1, 1], for each component of the last dimension.

    Args:
        size: Number of components.
    """

    low: torch.Tensor
    high: torch.Tensor

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("low", -torch.ones(size))
        self.register_buffer("high", torch.ones(size))

    def fit(self, data: torch.Tensor) -> None:
        """Take the range from data (..., size)."""
        flat = data.reshape(-1, data.shape[-1]).float()
        self.low.copy_(flat.amin(0))
        self.high.copy_(flat.amax(0))

    def _scale(self) -> tuple[torch.Tensor, torch.Tensor]:
        return (self.high + self.low) / 2, ((self.high - self.low) / 2).clamp(min=MIN_RANGE)

    def normalize(self, data: torch.Tensor) -> torch.Tensor:
        """Map data (..., size) to [-1, 1]."""
        centre, half = self._scale()
        return (data - centre) / half

    def restore(self, data: torch.Tensor) -> torch.Tensor:
        """Undo `normalize`."""
        centre, half = self._scale()
        return data * half + centre
