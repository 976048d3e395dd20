"""Padding of images to a common size, and tiling."""

from typing import Any, cast

import torch
from mani_skill.utils.visualization.misc import tile_images
from torch.nn.functional import pad


def tiled(images: list[torch.Tensor]) -> torch.Tensor:
    """Images (N, H, W, 3) of any sizes beside each other in two rows, on their device; ManiSkill's tiles are on the CPU."""
    whole: Any = tile_images(cast(Any, same_size(images)), nrows=2)
    return whole.to(images[0].device)


def same_size(images: list[torch.Tensor]) -> list[torch.Tensor]:
    """Images (N, H, W, 3), padded in black at the right and below to one size."""
    height, width = (max(image.shape[axis] for image in images) for axis in (1, 2))
    return [_padded(image, height, width) for image in images]


def same_height(images: list[torch.Tensor]) -> list[torch.Tensor]:
    """Images (N, H, W, 3), padded in black below to one height."""
    height = max(image.shape[1] for image in images)
    return [_padded(image, height, image.shape[2]) for image in images]


def _padded(image: torch.Tensor, height: int, width: int) -> torch.Tensor:
    return pad(image, (0, 0, 0, width - image.shape[2], 0, height - image.shape[1]))
