"""Everything a network sees or says, scaled to [-1, 1] by the range it has in the demonstrations."""

import torch
import torch.nn as nn

MIN_RANGE = 1e-3  # what hardly moves is shifted, not blown up


class Normalizer(nn.Module):
    """Affine map, per last dimension, of the data's range to [-1, 1]."""

    low: torch.Tensor
    high: torch.Tensor

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("low", -torch.ones(size))
        self.register_buffer("high", torch.ones(size))

    def fit(self, data: torch.Tensor) -> None:
        flat = data.reshape(-1, data.shape[-1]).float()
        self.low.copy_(flat.amin(0))
        self.high.copy_(flat.amax(0))

    def _scale(self) -> tuple[torch.Tensor, torch.Tensor]:
        return (self.high + self.low) / 2, ((self.high - self.low) / 2).clamp(min=MIN_RANGE)

    def normalize(self, data: torch.Tensor) -> torch.Tensor:
        centre, half = self._scale()
        return (data - centre) / half

    def restore(self, data: torch.Tensor) -> torch.Tensor:
        centre, half = self._scale()
        return data * half + centre
