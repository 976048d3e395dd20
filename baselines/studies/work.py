"""What the cost of a demonstration, a gradient step or an episode depends on.

Jobs that differ in amounts or seeds alone are the same work.
"""

import json
from typing import Any

from .planning import Job

AMOUNTS = ("num", "episodes", "checkpoints", "version", "revision")
"""Settings on which the cost of one demonstration, gradient step or episode does not depend."""
AMOUNT_FLAGS = frozenset(
    {
        *("seed", "env-id", "cameras", "keep", "save-every", "num-demos", "tacrgb-weights"),
        *("steps", "epochs", "min-iters"),
    }
)
"""Flags of training on which the cost of one gradient step does not depend; a study's policies have one camera each."""


def work_of(job: Job, gpus: float) -> str:
    """The work of a job, as json; an evaluation's is also that of its policy.

    Args:
        job: The job.
        gpus: Number of GPUs that the study gives the job.
    """
    policies = [without_amounts(need.settings) for need in job.needs if need.kind == "train"]
    return json.dumps([job.kind, bool(gpus), without_amounts(job.settings), *policies], sort_keys=True)


def without_amounts(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings of a job on which the cost of one demonstration, gradient step or episode depends."""
    flags = {name: value for name, value in settings.get("flags", {}).items() if name not in AMOUNT_FLAGS}
    return {name: value for name, value in settings.items() if name not in AMOUNTS} | dict(flags=flags)
