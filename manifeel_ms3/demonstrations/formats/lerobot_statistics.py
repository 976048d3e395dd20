"""Statistics of features as lerobot computes them: of images by channel, in [0, 1]; of arrays by their last axis."""

from typing import Any

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
"""Quantiles by the names that lerobot gives them."""
BRIGHTEST = 255
"""Value of a uint8 image that lerobot maps to 1."""


def episode_statistics(values: np.ndarray) -> dict[str, list]:
    """Statistics of a feature (T, ...) over one episode; those of images are (3, 1, 1)."""
    is_image = values.dtype == np.uint8
    flat = values.reshape(-1, values.shape[-1] if values.ndim > 1 else 1).astype(float) / (BRIGHTEST if is_image else 1)
    found = dict(min=flat.min(0), max=flat.max(0), mean=flat.mean(0), std=flat.std(0))
    found |= {name: np.quantile(flat, q, axis=0) for name, q in QUANTILES.items()}
    shape = (-1, 1, 1) if is_image else (-1,)
    return {name: value.reshape(shape).tolist() for name, value in found.items()} | dict(count=[len(values)])


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
