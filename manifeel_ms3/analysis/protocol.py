"""The paper's protocol: the success of a condition is the mean over the last ten checkpoints, all episodes and training seeds.

A `Condition` is what is compared: a task, its observations and a policy. The results of a condition are collected from result
files. The difference of two conditions is taken episode by episode, since both are evaluated on the same initial states.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from manifeel_ms3.evaluation.result import ResultError
from manifeel_ms3.evaluation.statistics import wilson_interval
from manifeel_ms3.tasks.registry import short_name

LAST = 10
"""Number of checkpoints at the end of training that a mean is taken over (the paper's protocol)."""
PAPER_NETWORK = "resnet18"
"""Encoder of camera images in the paper's policies."""
RESAMPLES = 4000
"""Number of resamples of a bootstrap or permutation test; the ends of intervals then vary by less than half a point."""
CONFIDENCE = 0.95
"""Confidence of every interval."""
SENSING = ("obs_mode", "cameras", "tactile_sensors", "sim_backend", "render_backend", "sensor_configs")
"""Arguments of an environment that do not change the task: what is observed, and what computes it."""


@dataclass(frozen=True)
class Condition:
    """A task, its observations and a policy: everything but the training seed."""

    env_id: str
    """Id of the task."""
    obs_mode: str
    """Observation mode, such as "rgb+tacff"."""
    policy: str
    """Registered name of the policy, or the name of its class."""
    encoder: str = ""
    """Encoder of TacRGB images; empty without them."""
    cameras: tuple[str, ...] = ()
    """Cameras that the policy observes."""
    num_demos: int | None = None
    """Number of training episodes; None where any number will do."""
    variant: str = ""
    """Arguments of the task other than its defaults, as json."""
    network: str = PAPER_NETWORK
    """Encoder of camera images, by which the paper's networks differ from smaller ones; empty for a policy that is no
    baseline."""

    @property
    def task(self) -> str:
        """Short name of the task."""
        return short_name(self.env_id)

    @property
    def sensing(self) -> str:
        """Observation mode and cameras, as a page shows them."""
        return " ".join((self.obs_mode, *self.cameras))


@dataclass(frozen=True)
class Estimate:
    """A number with its interval of 95 %."""

    value: float
    """The number itself."""
    low: float
    """Lower end of the interval."""
    high: float
    """Upper end of the interval."""

    def __str__(self) -> str:
        return f"{self.value:.0%} [{self.low:.0%}, {self.high:.0%}]"

    @property
    def signed(self) -> str:
        """Text of a difference, with its sign."""
        return f"{self.value:+.0%} [{self.low:+.0%}, {self.high:+.0%}]"


@dataclass
class ConditionResults:
    """Success of one condition in every evaluated episode."""

    success: np.ndarray
    """1 where an episode succeeded, else 0: (training seeds, checkpoints, episodes)."""
    episode_seeds: list[int]
    """Seeds of the episodes, which set their initial states; the same for all checkpoints."""

    @property
    def size(self) -> str:
        """Numbers of training seeds, checkpoints and episodes, such as "3 x 10 x 50"."""
        return " x ".join(map(str, self.success.shape))


def condition_of(result: dict[str, Any]) -> Condition:
    """The condition that a result belongs to.

    Entries of the policy's configuration that are of another type than the baselines' count as absent.
    """
    config = result["config"]
    encoders = _object(_object(config.get("policy")).get("encoder"))
    encoder = str(encoders.get("tacrgb", "")) if "tacrgb" in result["obs_mode"] else ""
    given = result["env_kwargs"].get("cameras")
    cameras = tuple(map(str, given)) if isinstance(given, (list, tuple)) and "rgb" in result["obs_mode"].split("+") else ()
    num_demos = config.get("num_demos")
    policy = result["policy"].rpartition(":")[2]
    other = {name: value for name, value in result["env_kwargs"].items() if name not in SENSING}
    variant = json.dumps(other, sort_keys=True) if other else ""
    network = str(encoders.get("image", ""))
    num_demos = num_demos if isinstance(num_demos, int) else None
    return Condition(result["env_id"], result["obs_mode"], policy, encoder, cameras, num_demos, variant, network)


def _object(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def collect(results: Iterable[dict[str, Any]], last: int = LAST) -> dict[Condition, ConditionResults]:
    """The results of each condition.

    Args:
        results: Contents of result files, one for each checkpoint.
        last: Largest number of checkpoints at the end of training that count.

    Raises:
        ResultError: The results of a condition are of different episodes, or two of them are of the same checkpoint.
    """
    found: dict[Condition, dict[int | None, dict[int, dict[int, bool]]]] = {}
    for result in results:
        outcomes = {episode["seed"]: episode["success_once"] for episode in result["episodes"]}
        condition, seed, step = condition_of(result), result["training_seed"], result["config"].get("step", 0)
        steps = found.setdefault(condition, {}).setdefault(seed, {})
        if step in steps:
            raise ResultError(f"two results of {condition} are of training seed {seed} and step {step}; leave one of them out")
        steps[step] = outcomes
    return {condition: _stacked(condition, by_seed, last) for condition, by_seed in found.items()}


def _stacked(condition: Condition, by_seed: dict[int | None, dict[int, dict[int, bool]]], last: int) -> ConditionResults:
    checkpoints = min(last, *(len(steps) for steps in by_seed.values()))
    evaluated = [[steps[step] for step in sorted(steps)[-checkpoints:]] for steps in by_seed.values()]
    seeds = sorted(evaluated[0][0])
    for outcomes in (outcomes for run in evaluated for outcomes in run):
        if sorted(outcomes) != seeds:
            raise ResultError(
                f"the results of {condition} are of different initial states; evaluate all of them with as many --episodes"
            )
    success = np.array([[[outcomes[seed] for seed in seeds] for outcomes in run] for run in evaluated], float)
    return ConditionResults(success, seeds)


def mean_success(*tasks: ConditionResults) -> Estimate:
    """Mean success over conditions, each weighing the same.

    Its interval is from a bootstrap over the training seeds within each condition (stratified, as in Agarwal et al. 2021), or
    over episodes where only one seed was trained. A single checkpoint has Wilson's interval.
    """
    if len(tasks) == 1 and tasks[0].success.shape[:2] == (1, 1):
        succeeded, episodes = int(tasks[0].success.sum()), len(tasks[0].episode_seeds)
        return Estimate(succeeded / episodes, *wilson_interval(succeeded, episodes))
    samples = [task.success.mean((1, 2)) if len(task.success) > 1 else task.success.mean((0, 1)) for task in tasks]

    def mean(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
        return np.mean([sample.mean(axis) for sample in samples], axis=0)

    return _estimate(samples, mean, tasks, paired=False)


def difference(first: ConditionResults, second: ConditionResults) -> tuple[Estimate, float]:
    """How much more often the first condition succeeds than the second, and the p-value of no difference.

    The interval is from a bootstrap over episodes, the p-value from a paired permutation test.

    Raises:
        ResultError: The two were evaluated on different episodes.
    """
    if first.episode_seeds != second.episode_seeds:
        raise ResultError(
            "the two conditions were evaluated on different initial states; evaluate both with as many --episodes"
        )
    samples = [results.success.mean((0, 1)) for results in (first, second)]

    def gap(first: np.ndarray, second: np.ndarray, axis: int = -1) -> np.ndarray:
        return first.mean(axis) - second.mean(axis)

    test = stats.permutation_test(
        samples, gap, permutation_type="samples", vectorized=True, n_resamples=RESAMPLES, rng=np.random.default_rng(0)
    )
    return _estimate(samples, gap, (first, second), paired=True), float(test.pvalue)


def _estimate(
    samples: list[np.ndarray], statistic: Callable[..., Any], of: tuple[ConditionResults, ...], paired: bool
) -> Estimate:
    value = float(statistic(*samples))
    if all(np.ptp(sample) == 0 for sample in samples):  # nothing varies, so that a bootstrap has nothing to draw from:
        fewest = min(len(results.episode_seeds) for results in of)
        unseen = wilson_interval(0, fewest)[1]  # the rate that an outcome may have which none of so many episodes has shown
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
