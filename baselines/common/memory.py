"""How a training process lays its weights out, and what it does with memory that it freed."""

import ctypes
import sys

import torch
import torch.nn as nn

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # mallopt(3)


def keep_freed_memory(device: torch.device | str) -> None:
    """Let this process keep what it frees, where it trains on the CPU, on Linux with glibc.

    glibc gives every large block back at once; the system clears it before it hands it out anew, at each step of training.
    """
    concerned = torch.device(device).type == "cpu" and sys.platform == "linux"
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if concerned else None
    if mallopt:
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, -1)


def lay_out_channels_last(module: nn.Module) -> None:
    """Weights of two-dimensional convolutions as the libraries' fast ones want them; before the optimiser is made."""
    for parameter in module.parameters():
        if parameter.dim() == 4:
            parameter.data = parameter.data.to(memory_format=torch.channels_last)
