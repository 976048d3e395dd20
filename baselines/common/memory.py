"""Memory of a training process: its freed blocks, and the layout of weights."""

import ctypes
import sys

import torch
import torch.nn as nn

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
"""Parameters of glibc's mallopt(3)."""
IMAGE_DIMENSIONS = 4
"""Number of dimensions of the weights of a two-dimensional convolution."""


def keep_freed_memory(device: torch.device | str) -> None:
    """Let this process keep the memory that it frees, if it trains on the CPU on Linux with glibc.

    By default glibc returns every large block to the system at once, and the system clears the block before the process gets
    it again, at each training step.
    """
    applies = torch.device(device).type == "cpu" and sys.platform == "linux"
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if applies else None
    if mallopt:
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, -1)


def return_freed_memory() -> None:
    """Give the memory that this process has freed back to the system, on Linux with glibc.

    By default glibc keeps small and middle-sized blocks that are freed, except at the end of the process's memory.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim:
        trim(0)


def lay_out_channels_last(module: nn.Module) -> None:
    """Store the weights of two-dimensional convolutions channels last, which is faster.

    It must be called before the optimiser is made.
    """
    for parameter in module.parameters():
        if parameter.dim() == IMAGE_DIMENSIONS:
            parameter.data = parameter.data.to(memory_format=torch.channels_last)
