"""Random numbers that are functions of an episode's seed, for many episodes at once."""

import numpy as np

# SplitMix64 (Steele, Lea & Flood 2014, "Fast splittable pseudorandom number generators"): its increment and mixing constants
INCREMENT, FIRST, SECOND = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
MANTISSA = np.uint64(11)  # bits that do not fit a float64


def _mixed(state: np.ndarray) -> np.ndarray:
    state = (state ^ (state >> np.uint64(30))) * FIRST
    state = (state ^ (state >> np.uint64(27))) * SECOND
    return state ^ (state >> np.uint64(31))


def uniform_draws(seeds: np.ndarray, stream: int, count: int) -> np.ndarray:
    """Numbers (P, count), uniform in [-1, 1); each row is a function of its seed and of the stream.

    Args:
        seeds: Seeds (P,) of P episodes.
        stream: Number that separates draws for different purposes.
        count: Numbers for each seed.
    """
    with np.errstate(over="ignore"):  # arithmetic modulo 2^64
        row = _mixed(np.asarray(seeds).astype(np.uint64) * INCREMENT + np.uint64(stream + 1))
        bits = _mixed(row[:, None] + INCREMENT * np.arange(1, count + 1, dtype=np.uint64))
    return (bits >> MANTISSA) * 2.0**-52 - 1.0
