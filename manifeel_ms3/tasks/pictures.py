"""Pictures of one size, to be tiled."""

import torch
import torch.nn.functional as F


def same_size(images: list[torch.Tensor]) -> list[torch.Tensor]:
    """Pictures (N, H, W, 3) framed in black to one size."""
    height, width = (max(image.shape[axis] for image in images) for axis in (1, 2))
    return [_framed(image, height, width) for image in images]


def same_height(images: list[torch.Tensor]) -> list[torch.Tensor]:
    """Pictures (N, H, W, 3) framed in black below to one height."""
    height = max(image.shape[1] for image in images)
    return [_framed(image, height, image.shape[2]) for image in images]


def _framed(image: torch.Tensor, height: int, width: int) -> torch.Tensor:
    return F.pad(image, (0, 0, 0, width - image.shape[2], 0, height - image.shape[1]))
