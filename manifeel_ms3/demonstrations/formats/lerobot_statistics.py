"""Statistics of features as lerobot computes them: of images by channel, in [0, 1]; of arrays by their last axis."""

from typing import Any

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
"""Quantiles by the names that lerobot gives them."""
BRIGHTEST = 255
"""Value of a uint8 image that lerobot maps to 1."""


def episode_statistics(values: np.ndarray) -> dict[str, list]:
    """Statistics of a feature (T, ...) over one episode; those of images are (3, 1, 1)."""
    if values.dtype == np.uint8:
        channels = [_image_statistics(values[..., c]) for c in range(values.shape[-1])]
        found = {name: np.reshape([channel[name] for channel in channels], (-1, 1, 1)) for name in channels[0]}
    else:
        flat = values.reshape(-1, values.shape[-1] if values.ndim > 1 else 1).astype(float)
        found = dict(min=flat.min(0), max=flat.max(0), mean=flat.mean(0), std=flat.std(0))
        found |= {name: np.quantile(flat, q, axis=0) for name, q in QUANTILES.items()}
    return {name: value.tolist() for name, value in found.items()} | dict(count=[len(values)])


def _image_statistics(channel: np.ndarray) -> dict[str, float]:
    """Statistics of one channel of images, in [0, 1], from how often each of its 256 values occurs."""
    counts = np.bincount(channel.ravel(), minlength=BRIGHTEST + 1)
    levels, up_to = np.arange(BRIGHTEST + 1) / BRIGHTEST, np.cumsum(counts)
    mean = np.average(levels, weights=counts)
    found = dict(min=levels[counts > 0][0], max=levels[counts > 0][-1], mean=mean)
    found["std"] = np.sqrt(np.average((levels - mean) ** 2, weights=counts))
    for name, q in QUANTILES.items():  # between two values linearly, as in np.quantile
        place = q * (channel.size - 1)
        below, above = (levels[np.searchsorted(up_to, rank, side="right")] for rank in (np.floor(place), np.ceil(place)))
        found[name] = below + (above - below) * (place % 1)
    return found


def joined_statistics(name: str, entries: list[dict[str, Any]]) -> dict[str, list]:
    """Statistics of a feature over all episodes, from those of each; quantiles are weighted means, as in lerobot.

    Args:
        name: Name of the feature.
        entries: Entries of the episodes in meta/episodes.
    """
    of = {
        what: np.array([entry[f"stats/{name}/{what}"] for entry in entries])
        for what in ("min", "max", "mean", "std", *QUANTILES)
    }
    weight = np.array([entry["length"] for entry in entries], float)
    weight /= weight.sum()

    def mean(values: np.ndarray) -> np.ndarray:
        return np.tensordot(weight, values, 1)

    found = dict(min=of["min"].min(0), max=of["max"].max(0), mean=mean(of["mean"]))
    found["std"] = np.sqrt(np.maximum(mean(of["std"] ** 2 + of["mean"] ** 2) - found["mean"] ** 2, 0))
    found |= {what: mean(of[what]) for what in QUANTILES}
    return {what: value.tolist() for what, value in found.items()} | dict(count=[sum(entry["length"] for entry in entries)])
