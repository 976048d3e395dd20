"""Images on their way to a network: cropped, and scaled to [-1, 1]."""

import torch


def network_images(images: torch.Tensor, crop: int, at_random: bool) -> torch.Tensor:
    """Images (B, T, H, W, 3) as networks take them: (B * T, 3, H, W), cropped, and in [-1, 1] where they were uint8.

    Args:
        images: The images, uint8, or floats that are normalised already.
        crop: Side of the crops, pixels; 0 for whole images.
        at_random: Whether crops are taken at random places; else the centre is taken.
    """
    return scaled(cropped(images, crop, at_random).flatten(0, 1).movedim(-1, 1))


def scaled(values: torch.Tensor) -> torch.Tensor:
    """Images of uint8 as floats in [-1, 1]; floats, which are normalised already, as they are."""
    return values.float() / 127.5 - 1.0 if values.dtype == torch.uint8 else values


def cropped(images: torch.Tensor, size: int, at_random: bool) -> torch.Tensor:
    """Square crops of images.

    Args:
        images: Windows of images, (B, T, H, W, 3).
        size: Side of the crops, pixels; if it is 0 or not smaller than the images, they are returned whole.
        at_random: Whether each window is cropped at a random place, the same for all its time steps; else the centre is taken.
    """
    free = images.shape[2] - size
    if not 0 < size < images.shape[2]:
        return images
    if not at_random:
        return images[:, :, free // 2 : free // 2 + size, free // 2 : free // 2 + size]
    batch = torch.arange(len(images), device=images.device)
    top, left = torch.randint(free + 1, (2, len(images)), device=images.device)
    span = torch.arange(size, device=images.device)
    rows, cols = (top[:, None] + span)[:, :, None], (left[:, None] + span)[:, None, :]
    return images.movedim(1, 3)[batch[:, None, None], rows, cols].movedim(3, 1)
