"""Layers that are equivariant under eighths of a turn, the cyclic group C8 (Cohen & Welling 2016).

A regular field holds one value for every rotation g in each of its channels: (B, C, 8, ...). If the input turns by h, the
values of a regular field move from g to g + h. Rotations are counter-clockwise, both of images as displayed (columns to the
right, rows down) and of vectors with x to the right and y up.
"""

import math

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F  # noqa: N812

ORDER = 8
"""Number of rotations in the group."""
RING_WIDTH = 0.6
"""Standard deviation of a filter ring's radial profile, pixels, as in the public code of Weiler & Cesa (2019)."""


def rotation(g: int) -> np.ndarray:
    """The matrix (2, 2) that turns vectors by g eighths of a turn."""
    c, s = math.cos(2 * math.pi * g / ORDER), math.sin(2 * math.pi * g / ORDER)
    return np.array([[c, -s], [s, c]])


def representation(size: int, pairs: tuple[tuple[int, int], ...]) -> torch.Tensor:
    """The matrices (8, size, size) that turn `size` numbers, of which the given pairs are vectors and the others scalars."""
    turns = np.tile(np.eye(size), (ORDER, 1, 1))
    for g in range(ORDER):
        for pair in pairs:
            turns[g][np.ix_(pair, pair)] = rotation(g)
    return torch.as_tensor(turns, dtype=torch.float32)


def to_regular(values: torch.Tensor, turns: torch.Tensor) -> torch.Tensor:
    """Numbers (..., D) in the frames that are turned by every g: a regular field (8, ..., D) along the first axis."""
    return torch.einsum("gba,...b->g...a", turns, values)  # the inverse of a rotation is its transpose


def from_regular(values: torch.Tensor, turns: torch.Tensor) -> torch.Tensor:
    """The mean (..., D) over all frames of numbers (8, ..., D), each turned back from its frame."""
    return torch.einsum("gab,g...b->...a", turns, values) / ORDER


def filter_basis(size: int) -> torch.Tensor:
    """Filters (8, n, size^2): n circular waves on rings, of unit norm, turned by every g (Weiler & Cesa 2019, section 2.7).

    Sums of these filters turn as smoothly as the waves do, whereas a free filter of 3 x 3 is not defined between its weights.
    """
    half = size // 2
    row, column = np.divmod(np.arange(size * size), size)
    radius, angle = np.hypot(column - half, half - row), np.arctan2(half - row, column - half)
    waves = []
    for ring in range(half + 1):
        profile = np.exp(-((radius - ring) ** 2) / (2 * RING_WIDTH**2)) * (radius <= half + 0.5)
        for frequency in range(2 * ring + 1):
            for phase in (0.0, np.pi / 2)[: 1 + (frequency > 0)]:
                turned = [np.cos(frequency * (angle - 2 * np.pi * g / ORDER) - phase) * profile for g in range(ORDER)]
                if frequency:
                    turned = [np.where(radius == 0, 0.0, wave) for wave in turned]
                waves.append(np.stack(turned) / np.linalg.norm(turned[0]))
    return torch.as_tensor(np.stack(waves, axis=1), dtype=torch.float32)


class GroupConv(nn.Module):
    """Convolution (B, C * 8, H, W) of regular fields, or (B, C, H, W) of an image, to regular fields (B, C * 8, H, W).

    The rotations of a channel lie next to each other.

    Args:
        inputs: Number of input channels.
        outputs: Number of output channels.
        size: Side of the filters, pixels.
        lifting: Whether the input is an image, not a regular field.
        padded: Whether the rim is repeated around the input; else the output is smaller by the filters' rim.
    """

    basis: torch.Tensor
    shift: torch.Tensor

    def __init__(self, inputs: int, outputs: int, size: int, lifting: bool = False, padded: bool = True):
        super().__init__()
        self.size, self.lifting, self.padded = size, lifting, padded
        seen = 1 if lifting else ORDER
        self.register_buffer("basis", filter_basis(size), persistent=False)
        waves = self.basis.shape[1]
        self.weight = nn.Parameter(torch.randn(outputs, inputs, seen, waves) * math.sqrt(2 / (inputs * seen * waves)))
        self.bias = nn.Parameter(torch.zeros(outputs))
        g = torch.arange(ORDER)
        self.register_buffer("shift", (g - g[:, None]) % ORDER, persistent=False)  # the input's rotation relative to g

    def forward(self, fields: torch.Tensor) -> torch.Tensor:
        turned = torch.einsum("gqp,oihq->goihp", self.basis, self.weight)
        if not self.lifting:
            index = self.shift[:, None, None, :, None].expand(*turned.shape)
            turned = turned.gather(3, index)
        outputs, inputs, seen, _ = self.weight.shape
        kernel = turned.movedim(0, 1).reshape(outputs * ORDER, inputs * seen, self.size, self.size)
        rim = self.size // 2
        if rim and self.padded:  # padding with zeros would draw a square border, which only quarter turns leave unchanged
            fields = F.pad(fields, (rim, rim, rim, rim), mode="replicate")
        return F.conv2d(fields, kernel, self.bias.repeat_interleave(ORDER))


class FieldNorm(nn.Module):
    """GroupNorm whose scale and shift are the same for all rotations of a channel.

    Args:
        groups: Number of groups.
        channels: Number of regular channels.
    """

    def __init__(self, groups: int, channels: int):
        super().__init__()
        self.groups = groups
        self.weight, self.bias = nn.Parameter(torch.ones(channels)), nn.Parameter(torch.zeros(channels))

    def forward(self, fields: torch.Tensor) -> torch.Tensor:
        return F.group_norm(fields, self.groups, self.weight.repeat_interleave(ORDER), self.bias.repeat_interleave(ORDER))


def halve(fields: torch.Tensor) -> torch.Tensor:
    """Fields (B, C, H, W) of half the height and width, by means over windows that are symmetric for even and odd sides."""
    if fields.shape[-1] % 2 == 0:
        return F.avg_pool2d(fields, 2)
    return F.avg_pool2d(fields, 3, stride=2, padding=1, count_include_pad=False)


def pooled(fields: torch.Tensor, factor: int) -> torch.Tensor:
    """The largest values of fields (B, C, H, W) in windows, of which there are `factor` times fewer along each side.

    Where the sides are not multiples of the factor, windows overlap symmetrically, so that quarter turns stay exact.
    """
    return F.adaptive_max_pool2d(fields, [max(side // factor, 1) for side in fields.shape[2:]])


def turned(fields: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Regular fields (B, C, 8) turned by any angles (B,), in rad.

    A field is a function on the circle that is known at eight places; between them it is the sum of the waves of up to four
    periods that has these values. Turns by multiples of 45 degrees move the values on, and turns add up with those of the
    group.
    """
    places = torch.arange(ORDER, device=fields.device) * (2 * math.pi / ORDER)
    apart = places[:, None] - places - angle[:, None, None]  # (B, 8, 8), from each place moved on to each place
    waves = 1 + 2 * sum(torch.cos(n * apart) for n in range(1, ORDER // 2)) + torch.cos(ORDER // 2 * apart)
    return torch.einsum("bgh,bch->bcg", waves / ORDER, fields)
