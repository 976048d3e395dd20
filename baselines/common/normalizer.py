"""Scaling of a network's inputs and outputs to [-1, 1] by their ranges in the demonstrations."""

from collections.abc import Iterable

import torch
import torch.nn as nn

MIN_RANGE = 1e-3
"""Smallest half range by which data are divided, in their own unit, so that values that hardly vary are shifted but not
magnified; set once, not tuned."""
TAXEL_SHARE = 0.05
"""Smallest half range by which a component of a taxel is divided, as a share of the largest half range of that component over
all taxels, so that a taxel that is hardly touched is not magnified to the size of one that carries the grip; docs/policies.md
shows its effect."""
MIN_TOUCH = 1e-6
"""Smallest half range by which a force field is divided, in N, or in m with units="tacsl"; set once, not tuned."""
MIN_GREY = 1.0
"""Smallest half range by which a pixel of TacRGB is divided, in grey levels, so that its noise is not magnified."""
PIXEL_SHARE = 0.1
"""The same as a share of the largest half range among all pixels; set once, not tuned."""


class Normalizer(nn.Module):
    """Affine map of the data's range to [-1, 1], for each component.

    Args:
        shape: Number of components, or shape of the components: the last dimensions of the data.
        min_range: Smallest half range by which data are divided, in their own unit.
        min_share: The same as a share of the largest half range among the components with the same last index.
    """

    low: torch.Tensor
    high: torch.Tensor

    def __init__(self, shape: int | tuple[int, ...], min_range: float = MIN_RANGE, min_share: float = 0.0):
        super().__init__()
        self.min_range, self.min_share = min_range, min_share
        self.register_buffer("low", -torch.ones(shape))
        self.register_buffer("high", torch.ones(shape))

    @classmethod
    def of_taxels(cls, taxel_shape: tuple[int, int]) -> "Normalizer":
        """The normaliser of a force field: every component of every taxel has its own range.

        The taxels at the border also stand for the gel beyond them, and carry most of a grip. They would set a range that all
        taxels share, and changes in the middle of the gel would be a small part of it (docs/policies.md).
        """
        return cls((*taxel_shape, 3), MIN_TOUCH, TAXEL_SHARE)

    @classmethod
    def of_pixels(cls, size: int) -> "Normalizer":
        """The normaliser of square TacRGB images: every colour of every pixel has its own range, as in `of_taxels`.

        Args:
            size: Side of the images, pixels.
        """
        return cls((size, size, 3), MIN_GREY, PIXEL_SHARE)

    def fit(self, data: torch.Tensor) -> None:
        """Take the range from data (..., *shape)."""
        flat = data.reshape(-1, *self.low.shape)
        self.low.copy_(flat.amin(0))
        self.high.copy_(flat.amax(0))

    def _scale(self) -> tuple[torch.Tensor, torch.Tensor]:
        half = (self.high - self.low) / 2
        least = self.min_share * half.reshape(-1, half.shape[-1]).amax(0)
        return (self.high + self.low) / 2, torch.maximum(half, least).clamp(min=self.min_range)

    def normalize(self, data: torch.Tensor) -> torch.Tensor:
        """Map data (..., size) to [-1, 1]."""
        centre, half = self._scale()
        return (data - centre) / half

    def restore(self, data: torch.Tensor) -> torch.Tensor:
        """Undo `normalize`."""
        centre, half = self._scale()
        return data * half + centre


class ActionNormalizer(Normalizer):
    """Map of actions to [-1, 1], which can enlarge small actions relative to large ones.

    Where parts touch, a demonstrator's actions are a few percent of its largest action. On a linear scale such actions hardly
    change a squared error, although contact depends on them. On the scale "root", each action is first replaced by
    its square root with its sign, so that 4 % of the largest action becomes 20 %.

    Args:
        shape: Number of components of an action, or (T, A) if each step of a prediction has ranges of its own.
        root: Whether actions are replaced by their roots.
        pairs: Indices of components that are the x and y of a vector. Such a vector is divided by the root of its length, so
            that its direction stays.
    """

    def __init__(self, shape: int | tuple[int, ...], root: bool = False, pairs: Iterable[tuple[int, int]] = ()):
        super().__init__(shape)
        self.root, self.pairs = root, [list(pair) for pair in pairs]

    @property
    def limit(self) -> float:
        """Largest size of a component of an action: 1, or infinity if demonstrations go beyond, as those of joint angles do."""
        return 1.0 if torch.stack([self.low, self.high]).abs().max() <= 1 else torch.inf

    def fit(self, data: torch.Tensor) -> None:
        super().fit(self._spread(data))

    def normalize(self, data: torch.Tensor) -> torch.Tensor:
        return super().normalize(self._spread(data))

    def restore(self, data: torch.Tensor) -> torch.Tensor:
        restored = super().restore(data)
        return restored * self._length(restored) if self.root else restored

    def _spread(self, actions: torch.Tensor) -> torch.Tensor:
        return actions / self._length(actions).clamp(min=torch.finfo(torch.float32).tiny).sqrt() if self.root else actions

    def _length(self, actions: torch.Tensor) -> torch.Tensor:
        length = actions.abs()
        for pair in self.pairs:
            length[..., pair] = actions[..., pair].norm(dim=-1, keepdim=True)
        return length
