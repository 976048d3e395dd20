# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# pyright: reportCallIssue=false, reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false
# (warp reads a kernel's annotations as its own types, and its stubs do not know the vectors' operators)
"""Random numbers that are functions of an episode's seed, for many episodes at once."""

from zlib import crc32

import numpy as np
import torch
import warp as wp

from .warp_device import warp_device

LOWEST_32_BITS = (1 << 32) - 1
"""Mask of the part of a seed from which is drawn."""
STREAM_STRIDE = 1 << 20
"""Distance of the offsets at which streams begin: more than the numbers that any stream draws."""


EPISODE_STRIDE = 0x9E3779B1
"""Factor of the multiplicative hash by which the seeds of episodes differ that have the same seed of a reset: the prime near
2^32 divided by the golden ratio (Knuth, The Art of Computer Programming 3, 6.4)."""
UNCHANGED = "tactile_right"
"""Pad that draws from the episode's seed itself, as it did before the pads' draws were told apart."""


def pad_seeds(seeds: np.ndarray, episodes: np.ndarray, pad: str) -> np.ndarray:
    """Seeds (n,) from which a pad draws, others for each pad and for each episode.

    Args:
        seeds: Seeds (n,) of the last resets with a seed.
        episodes: Numbers (n,) of earlier episodes since then.
        pad: Name of the pad.
    """
    of_pad = 0 if pad == UNCHANGED else crc32(pad.encode())
    return seeds ^ of_pad ^ (episodes * EPISODE_STRIDE & LOWEST_32_BITS)


@wp.kernel
def _draw(seed: wp.array(dtype=wp.int32), begin: int, drawn: wp.array2d(dtype=wp.float32)):
    p, k = wp.tid()
    drawn[p, k] = wp.randf(wp.rand_init(seed[p], begin + k), -1.0, 1.0)


def uniform_draws(seeds: np.ndarray, stream: int, count: int) -> np.ndarray:
    """Numbers (P, count), uniform in [-1, 1); each row is a function of its seed's lowest 32 bits and of the stream.

    Args:
        seeds: Seeds (P,) of P episodes.
        stream: Number that separates draws for different purposes.
        count: Numbers for each seed.
    """
    cpu = warp_device(torch.device("cpu"))
    low = np.asarray(seeds).astype(np.int64).astype(np.int32)
    drawn = wp.empty((len(low), count), dtype=wp.float32, device=cpu)
    wp.launch(_draw, drawn.shape, [wp.array(low, device=cpu), stream * STREAM_STRIDE, drawn], device=cpu)
    return drawn.numpy().astype(np.float64)
