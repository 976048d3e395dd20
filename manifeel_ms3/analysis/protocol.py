"""The paper's protocol: a set-up's success is the mean over the last ten checkpoints, all starts and all training seeds.

What is compared is a `Setup`; what was run of it, its `Runs`, is collected from result files. A difference of two set-ups is
taken start by start, since both are evaluated on the same ones.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from manifeel_ms3.evaluation.result import ResultError
from manifeel_ms3.evaluation.statistics import wilson_interval
from manifeel_ms3.tasks.registry import short_name

LAST = 10  # checkpoints
PAPER_NETWORK = "resnet18"
RESAMPLES = 4000
CONFIDENCE = 0.95
SENSING = ("obs_mode", "cameras", "tactile_sensors", "sim_backend")  # arguments that do not change the task


@dataclass(frozen=True)
class Setup:
    """What a policy is: everything but its training seed."""

    env_id: str
    obs_mode: str
    policy: str
    """the class's name"""
    encoder: str = ""
    """of TacRGB"""
    cameras: tuple[str, ...] = ()
    num_demos: int | None = None
    variant: str = ""
    """arguments of the task other than its defaults, as json"""
    network: str = PAPER_NETWORK
    """encoder of cameras, which tells the paper's networks from smaller ones; "" for a policy that is no baseline"""

    @property
    def task(self) -> str:
        """The task's short name."""
        return short_name(self.env_id)

    @property
    def sensing(self) -> str:
        return " ".join((self.obs_mode, *self.cameras))


@dataclass(frozen=True)
class Estimate:
    """A number with its interval of 95 %."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.0%} [{self.low:.0%}, {self.high:.0%}]"

    @property
    def signed(self) -> str:
        """As a difference is told."""
        return f"{self.value:+.0%} [{self.low:+.0%}, {self.high:+.0%}]"


@dataclass
class Runs:
    """Success of a set-up: (training seeds, checkpoints, starts), in [0, 1]."""

    success: np.ndarray
    starts: list[int]
    """their seeds"""

    @property
    def size(self) -> str:
        return " x ".join(map(str, self.success.shape))


def setup_of(result: dict[str, Any]) -> Setup:
    config = result["config"]
    encoders = config.get("policy", {}).get("encoder", {})
    encoder = encoders.get("tacrgb", "") if "tacrgb" in result["obs_mode"] else ""
    cameras = tuple(result["env_kwargs"].get("cameras", ())) if "rgb" in result["obs_mode"].split("+") else ()
    policy = result["policy"].rpartition(":")[2]
    other = {name: value for name, value in result["env_kwargs"].items() if name not in SENSING}
    variant = json.dumps(other, sort_keys=True) if other else ""
    network = encoders.get("image", "")
    return Setup(result["env_id"], result["obs_mode"], policy, encoder, cameras, config.get("num_demos"), variant, network)


def collect(results: Iterable[dict[str, Any]], last: int = LAST) -> dict[Setup, Runs]:
    """Results, one a checkpoint, by set-up.

    Raises:
        ResultError: those of a set-up were evaluated on different starts.
    """
    found: dict[Setup, dict[int | None, dict[int, dict[int, bool]]]] = {}
    for result in results:
        outcomes = {episode["seed"]: episode["success_once"] for episode in result["episodes"]}
        runs = found.setdefault(setup_of(result), {})
        runs.setdefault(result["training_seed"], {})[result["config"].get("step", 0)] = outcomes
    return {setup: _runs(setup, by_seed, last) for setup, by_seed in found.items()}


def _runs(setup: Setup, by_seed: dict[int | None, dict[int, dict[int, bool]]], last: int) -> Runs:
    checkpoints = min(last, *(len(steps) for steps in by_seed.values()))
    evaluated = [[steps[step] for step in sorted(steps)[-checkpoints:]] for steps in by_seed.values()]
    starts = sorted(evaluated[0][0])
    for outcomes in (outcomes for run in evaluated for outcomes in run):
        if sorted(outcomes) != starts:
            raise ResultError(f"results of {setup} are of different starts; evaluate all of them with as many --episodes")
    return Runs(np.array([[[outcomes[start] for start in starts] for outcomes in run] for run in evaluated], float), starts)


def success(*tasks: Runs) -> Estimate:
    """Mean success over tasks, each weighing the same; interval from a bootstrap over training seeds within each task
    (stratified, as in Agarwal et al. 2021), or over starts where one was trained only. That of one checkpoint is Wilson's."""
    if len(tasks) == 1 and tasks[0].success.shape[:2] == (1, 1):
        won, starts = int(tasks[0].success.sum()), len(tasks[0].starts)
        return Estimate(won / starts, *wilson_interval(won, starts))
    samples = [runs.success.mean((1, 2)) if len(runs.success) > 1 else runs.success.mean((0, 1)) for runs in tasks]

    def mean(*samples, axis=-1):
        return np.mean([sample.mean(axis) for sample in samples], axis=0)

    return _estimate(samples, mean, tasks, paired=False)


def difference(better: Runs, worse: Runs) -> tuple[Estimate, float]:
    """How much more often the first succeeds, with an interval from a bootstrap over starts, and the p-value of a paired
    permutation test of no difference.

    Raises:
        ResultError: they were evaluated on different starts.
    """
    if better.starts != worse.starts:
        raise ResultError("the two were evaluated on different starts; evaluate both with as many --episodes")
    samples = [runs.success.mean((0, 1)) for runs in (better, worse)]

    def gap(first, second, axis=-1):
        return first.mean(axis) - second.mean(axis)

    test = stats.permutation_test(
        samples, gap, permutation_type="samples", vectorized=True, n_resamples=RESAMPLES, rng=np.random.default_rng(0)
    )
    return _estimate(samples, gap, (better, worse), paired=True), float(test.pvalue)


def _estimate(samples: list[np.ndarray], statistic, of: tuple[Runs, ...], paired: bool) -> Estimate:
    value = float(statistic(*samples))
    if all(np.ptp(sample) == 0 for sample in samples):  # nothing varies: the bootstrap has nothing to draw from
        unseen = wilson_interval(0, min(len(runs.starts) for runs in of))[1]  # what none of so many starts has shown
        return Estimate(value, max(value - unseen, -1.0 if paired else 0.0), min(value + unseen, 1.0))
    drawn = stats.bootstrap(
        samples,
        statistic,
        n_resamples=RESAMPLES,
        vectorized=True,
        paired=paired,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Estimate(value, float(drawn.low), float(drawn.high))
