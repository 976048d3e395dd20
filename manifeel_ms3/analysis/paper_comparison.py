"""Training times, and distances to real touch, beside the paper's: parts of the page of results."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from manifeel_ms3.evaluation.checkpoint_config import samples_per_step
from manifeel_ms3.files import read_json

from .condition import condition_of
from .markdown import markdown_table, shown
from .paper import DP, RUNTIME, RUNTIME_DEMOS, SIMILARITY, TACRGB

SECONDS_PER_MINUTE = 60
RUNTIME_TASKS = ("BallSorting", "BallSortingDim")
"""Short names of the tasks whose training times are compared."""
RUNTIME_TEXT = """
## Training time

Minutes for one epoch of Diffusion Policy with TacRGB in ball sorting, with {demos} demonstrations and batches of 8. The paper's
demonstrations were recorded on a real robot, so that its epochs differ in length from ours; samples per second do not depend on
that. The paper's GPU is an NVIDIA A30. `manifeel study configs/runtime.yaml` measures our times.
"""
SIMILARITY_TEXT = """
## Simulated and real touch

Distances between simulated and real tactile images in the feature space of a network; a smaller distance means that they are
more alike. The paper used a ResNet that it does not name. Our distances need images of a real sensor, which this repository
does not have: `manifeel similarity --sim peg.h5 --real IMAGES --object ball --features inception` measures them, and this page
shows them if it is given the folder of the measurement.
"""
_ESTIMATE = {
    "type": "object",
    "required": ["value", "low", "high"],
    "additionalProperties": {"type": "number"},
}
SIMILARITY_FORM = {
    "type": "object",
    "required": ["modality", "object", "features", "fid", "kid"],
    "properties": {
        "modality": {"type": "string"},
        "object": {"type": "string"},
        "features": {"type": "string"},
        "fid": _ESTIMATE,
        "kid": _ESTIMATE,
    },
}
"""Json schema of the files of `manifeel similarity`."""


def runtime_table(results: Sequence[dict[str, Any]]) -> str:
    """Markdown: minutes of an epoch by encoder of TacRGB, the paper's and those of the results at hand."""
    rows = []
    for encoder, minutes in RUNTIME.items():
        timed = {_timed(result): result for result in results if _is_of_runtime(result, encoder)}
        here = [(f"{one / SECONDS_PER_MINUTE:.1f}", f"{rate:.1f}", machine) for one, rate, machine in sorted(timed)]
        rows += [(encoder, minutes, *one) for one in here or [("not run", None, None)]]
    names = ("TacRGB encoder", "paper, min", "here, min", "here, samples per second", "on")
    return f"{RUNTIME_TEXT.format(demos=RUNTIME_DEMOS)}\n{markdown_table(names, rows)}"


def _is_of_runtime(result: dict[str, Any], encoder: str) -> bool:
    condition, config = condition_of(result), result["config"]
    asked = (condition.task in RUNTIME_TASKS, condition.policy == DP, condition.obs_mode == TACRGB)
    known = all(config.get(name) for name in ("training_seconds", "step", "num_samples", "trained_on"))
    known = known and samples_per_step(config) is not None and type(config["num_samples"]) is int and config["num_samples"] > 0
    return all(asked) and known and condition.encoder == encoder and condition.num_demos == RUNTIME_DEMOS


def _timed(result: dict[str, Any]) -> tuple[float, float, str]:
    """Seconds of an epoch, samples per second, and the machine."""
    config = result["config"]
    samples = samples_per_step(config)
    assert samples, "results of unknown batch size are left out"
    step_seconds = config["training_seconds"] / config["step"]
    epoch = step_seconds * math.ceil(config["num_samples"] / samples)
    return epoch, samples / step_seconds, shown(gpu_of_training(config) or config["trained_on"]["cpu"])


def gpu_of_training(config: dict[str, Any]) -> str | None:
    """Name of the GPU that trained a policy; None if a CPU did, also on a machine with a GPU."""
    return None if config.get("device") == "cpu" else config["trained_on"]["gpu"]


def similarity_table(files: Sequence[Path]) -> str:
    """Markdown: FID and KID by modality and object, the paper's and those of files that `manifeel similarity` wrote.

    Raises:
        InvalidFileError: A file was not written by `manifeel similarity`.
    """
    measured = [read_json(path, SIMILARITY_FORM, "a file of `manifeel similarity --object`") for path in files]
    rows = []
    for modality, objects in SIMILARITY.items():
        for name, (fid, kid) in objects.items():
            here = [one for one in measured if (one["modality"], one["object"]) == (modality, name)]
            cells = [(_interval(one["fid"]), _interval(one["kid"]), shown(one["features"])) for one in here]
            rows += [(modality, name, fid, kid, *one) for one in cells] or [
                (modality, name, fid, kid, "not measured", None, None)
            ]
    names = ("modality", "object", "paper, FID", "paper, KID", "here, FID", "here, KID", "features here")
    return f"{SIMILARITY_TEXT}\n{markdown_table(names, rows)}"


def _interval(estimate: dict[str, float]) -> str:
    return "{value:.3g} [{low:.3g}, {high:.3g}]".format(**estimate)
