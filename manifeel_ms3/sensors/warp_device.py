"""Warp, started quietly, on torch's devices."""

import torch
import warp as wp

wp.config.quiet = True
if hasattr(wp, "LOG_WARNING"):  # newer releases
    wp.config.log_level = wp.LOG_ERROR


def warp_device(device: torch.device):
    """Warp's device for torch's."""
    wp.init()
    return wp.device_from_torch(device)
