"""Equivariant networks over camera images: if the image turns by an eighth, their features (B, fields, 8) move on by one."""

from collections.abc import Callable
from itertools import pairwise

import torch
import torch.nn as nn

from .groups import ORDER, FieldNorm, GroupConv, halve, pooled, representation

CHANNELS_PER_GROUP = 16
"""Number of regular channels, or a few more, that a block of the small network normalises together; set once, not tuned."""
LIFT_KERNEL = 5
"""Kernel size of the first convolution, as in the paper's public code."""
LAST_POOLING = 3
"""Factor by which the last block's pooling shrinks the image, instead of 2, as in the paper's public code."""
RESNET_DIVISORS = (16, 16, 8, 4, 2, 1, 1)
"""Divisors of the number of fields of the features, which give the numbers of fields after the first convolution and after each
block, as in the paper's public code."""
KEY_POINT_DIVISORS = (32, 16, 8, 4)
"""The same divisors of the small network; chosen for training on a CPU."""


class GroupBlock(nn.Module):
    """Two convolutions of regular fields with a skip connection.

    Args:
        inputs: Number of input channels.
        outputs: Number of output channels.
        normalised: Whether each convolution is followed by a normalisation.
    """

    def __init__(self, inputs: int, outputs: int, normalised: bool):
        super().__init__()

        def norm() -> nn.Module:
            groups = next(n for n in range(max(outputs // CHANNELS_PER_GROUP, 1), 0, -1) if outputs % n == 0)
            return FieldNorm(groups, outputs) if normalised else nn.Identity()

        first, second = GroupConv(inputs, outputs, 3), GroupConv(outputs, outputs, 3)
        if not normalised:  # the sums of many blocks would otherwise grow a hundredfold before training (Goyal et al. 2017)
            nn.init.zeros_(second.weight)
        self.net = nn.Sequential(first, norm(), nn.ReLU(), second, norm())
        self.skip = GroupConv(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, fields: torch.Tensor) -> torch.Tensor:
        return (self.net(fields) + self.skip(fields)).relu()


class EquivariantResNet(nn.Module):
    """The encoder of the paper's public code (`EquivariantResEncoder230Cyclic`): six residual blocks, each followed by pooling.

    It differs in two places, so that quarter turns are exact: a rim is repeated instead of filled with zeros, and pooling
    windows are symmetric for odd sides. An image of 230 pixels has the sides 226, 113, 56, 28, 14, 7, 2 and 1.

    Args:
        fields: Number of regular fields of the features.
    """

    def __init__(self, fields: int):
        super().__init__()
        widths = [max(fields // k, 1) for k in RESNET_DIVISORS]
        self.lift = nn.Sequential(GroupConv(3, widths[0], LIFT_KERNEL, lifting=True, padded=False), nn.ReLU())
        self.blocks = nn.ModuleList(GroupBlock(i, o, normalised=False) for i, o in pairwise(widths))
        self.last = nn.Sequential(GroupConv(fields, fields, 3), nn.ReLU())

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        fields = self.lift(image)
        for k, block in enumerate(self.blocks, start=1):
            fields = pooled(block(fields), 2 if k < len(self.blocks) else LAST_POOLING)
        return self.last(fields).mean((2, 3)).unflatten(1, (-1, ORDER))


class EquivariantKeyPoints(nn.Module):
    """A small network for a CPU: heat maps, of which each gives its expected coordinates along the axes of every frame.

    Args:
        fields: Number of regular fields of the features, two for each key point.
    """

    axes: torch.Tensor

    def __init__(self, fields: int):
        super().__init__()
        widths = [max(fields // k, 1) for k in KEY_POINT_DIVISORS]
        self.lift = nn.Sequential(GroupConv(3, widths[0], LIFT_KERNEL, lifting=True), FieldNorm(1, widths[0]), nn.ReLU())
        self.blocks = nn.ModuleList(GroupBlock(i, o, normalised=True) for i, o in pairwise(widths))
        self.score = GroupConv(widths[-1], fields // 2, 1)
        self.register_buffer("axes", representation(2, ((0, 1),)), persistent=False)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        fields = self.lift(halve(image))
        for k, block in enumerate(self.blocks):
            fields = block(halve(fields) if k < 2 else fields)  # an eighth of the image's size at the end
        right = torch.linspace(-1, 1, fields.shape[3], device=image.device)
        up = torch.linspace(1, -1, fields.shape[2], device=image.device)
        outside = torch.hypot(right, up[:, None]) > 1  # turns leave the inscribed circle unchanged
        heat = self.score(fields).masked_fill(outside, -torch.inf)
        weight = heat.flatten(2).softmax(-1).view(len(image), -1, ORDER, *fields.shape[2:])
        place = torch.stack([(weight.sum(3) * right).sum(-1), (weight.sum(4) * up).sum(-1)], dim=-1)  # (B, points, 8, 2)
        return torch.einsum("gba,ncgb->ncag", self.axes, place).flatten(1, 2)


EQUIVARIANT_IMAGE_ENCODERS: dict[str, Callable[[int], nn.Module]] = {
    "resnet18": EquivariantResNet,
    "small_cnn": EquivariantKeyPoints,
}
"""Functions from a number of regular fields to a network (B, 3, size, size) -> (B, fields, 8), by the names of the networks
that other policies use in their place."""
