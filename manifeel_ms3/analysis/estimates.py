"""Success rates and their differences, with intervals over training seeds and initial states.

Another training seed gives another policy, another initial state another episode; a mean varies with both. The bootstrap
therefore draws both anew, each independently of the other (the pigeonhole bootstrap, Owen 2007), with the spread of small
samples corrected (Rao and Wu 1988). Checkpoints of one run are no independent samples: they are averaged before anything is
drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from manifeel_ms3.evaluation.result import ResultError
from manifeel_ms3.evaluation.statistics import wilson_interval

from .protocol import ConditionResults

Pair = tuple[ConditionResults, ConditionResults]
"""Two conditions that were evaluated on the same initial states."""
RESAMPLES = 40_000
"""Number of resamples of a bootstrap: another draw changes a p-value near 0.05 by 0.002 (standard deviation)."""
TAILS = (0.025, 0.975)
"""Quantiles at the ends of an interval of 95 %."""
SIGNIFICANT = 0.05
"""Largest p-value of a difference that counts as one."""
FEWEST_SEEDS = 3
"""Number of training seeds of a condition from which a difference says something about training, as many as in the paper's
protocol. Two runs that differ in their seed alone differ as much as two conditions often do: of the pairs of such runs in
leaderboard/cpu, more than one in ten have a p-value below 0.05 on the same 50 initial states."""
NEAR_NO_SUCCESS = 0.1
"""Success below which two conditions decide nothing about a small difference: both hardly learn the task."""
SMALLEST_SHOWN = 0.001
"""Smallest p-value that tables show as a number."""
NO_SPREAD = 1e-12
"""Range of resampled rates below which they differ only by rounding."""


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
        """Text of a difference in percentage points, with its sign."""
        value, low, high = (100 * number + 0.0 for number in (self.value, self.low, self.high))
        return f"{value:+.0f} [{low:+.0f}, {high:+.0f}]"


def mean_success(*tasks: ConditionResults) -> Estimate:
    """Mean success over conditions, each weighing the same.

    Its interval is from a bootstrap over training seeds and initial states, within each condition. A single checkpoint has
    Wilson's interval. Where a single seed was trained, the interval is of that one policy.
    """
    if len(tasks) == 1 and tasks[0].success.shape[:2] == (1, 1):
        succeeded, episodes = int(tasks[0].success.sum()), len(tasks[0].episode_seeds)
        return Estimate(succeeded / episodes, *wilson_interval(succeeded, episodes))
    rng = np.random.default_rng(0)
    drawn = [
        _resampled_means(_rates(task), _weights(rng, len(task.episode_seeds)), _weights(rng, len(task.success)))
        for task in tasks
    ]
    value = float(np.mean([task.success.mean() for task in tasks]))
    return _estimate(value, np.mean(drawn, axis=0), tasks, lowest=0.0)


def difference(first: ConditionResults, second: ConditionResults) -> tuple[Estimate, float]:
    """How much more often the first condition succeeds than the second, and the p-value of no difference.

    Both count with equally many checkpoints. The bootstrap draws the same initial states for both, and training seeds for each
    apart. The p-value is twice the share of resamples on the rarer side of zero. Where both have one run with one checkpoint,
    it is that of McNemar's exact test, and is about these two runs alone. The interval, which is the bootstrap's, can exclude
    zero where the test finds no difference, if the runs differ in five or fewer episodes; then the test is right.

    Raises:
        ResultError: The two were evaluated on different episodes.
    """
    estimate, p_value = mean_difference([(first, second)])
    sides = _paired_rates(first, second)
    if all(len(side) == 1 and set(np.unique(side)) <= {0.0, 1.0} for side in sides):
        p_value = _mcnemar(*(side[0] for side in sides))
    return estimate, p_value


def mean_difference(pairs: Sequence[Pair]) -> tuple[Estimate, float]:
    """Mean over pairs of how much more often the first condition succeeds, and the p-value of no difference on average.

    Each pair weighs the same. Initial states are drawn for each pair apart, as for different tasks, but the training seeds of a
    side for all pairs at once, because a seed gives the same initial weights and noise in every task.

    Raises:
        ResultError: The conditions of a pair were evaluated on different episodes.
    """
    rng = np.random.default_rng(0)
    values, resampled = [], []
    seeds: dict[tuple[int, int], np.ndarray] = {}
    for pair in pairs:
        sides = _paired_rates(*pair)
        starts = _weights(rng, len(pair[0].episode_seeds))
        means = []
        for k, rates in enumerate(sides):
            if (k, len(rates)) not in seeds:
                seeds[k, len(rates)] = _weights(rng, len(rates))
            means.append(_resampled_means(rates, starts, seeds[k, len(rates)]))
        values.append(float(sides[0].mean() - sides[1].mean()))
        resampled.append(means[0] - means[1])
    drawn = np.mean(resampled, axis=0)
    rarer = min((drawn <= 0).sum(), (drawn >= 0).sum())
    p_value = float(min(1.0, 2 * (1 + rarer) / (1 + RESAMPLES)))
    return _estimate(float(np.mean(values)), drawn, [side for pair in pairs for side in pair], lowest=-1.0), p_value


def p_text(p_value: float | None) -> str | None:
    """Text of a p-value for a table; None without one."""
    if p_value is None:
        return None
    return f"< {SMALLEST_SHOWN}" if p_value < SMALLEST_SHOWN else f"{p_value:.3f}"


def has_enough_seeds(*conditions: ConditionResults) -> bool:
    """Whether each condition has so many training seeds that their difference says something about training."""
    return all(len(results.success) >= FEWEST_SEEDS for results in conditions)


def _mcnemar(first: np.ndarray, second: np.ndarray) -> float:
    """P-value of McNemar's exact test of paired outcomes, 0 or 1 (episodes)."""
    from scipy.stats import binomtest  # takes a third of a second, needed only where two single runs are compared

    better, worse = int((first > second).sum()), int((first < second).sum())
    return float(binomtest(better, better + worse).pvalue) if better + worse else 1.0


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values after Holm's correction (1979) for several tests, in their order.

    The probability that any true hypothesis of the family has a corrected p-value below 5 % is 5 % at most, however the tests
    depend on each other. A hypothesis may therefore be chosen from the family after looking at the results.

    Args:
        p_values: P-values of all tests of the family.
    """
    order = np.argsort(p_values)
    factors = np.arange(len(order), 0, -1)
    corrected = np.empty(len(order))
    corrected[order] = np.maximum.accumulate(np.asarray(p_values)[order] * factors).clip(max=1.0)
    return corrected.tolist()


def resampled_success(conditions: Sequence[tuple[str, ConditionResults]], resamples: int = RESAMPLES) -> np.ndarray:
    """Mean success of several conditions in each resample, (conditions, resamples).

    Training seeds are drawn for each condition apart; initial states alike for all conditions of a task that share them.

    Args:
        conditions: The id of the task, and the results, of each condition.
        resamples: Number of resamples.
    """
    rng = np.random.default_rng(0)
    starts: dict[Any, np.ndarray] = {}
    drawn = []
    for task, results in conditions:
        same = (task, tuple(results.episode_seeds))
        if same not in starts:
            starts[same] = _weights(rng, len(results.episode_seeds), resamples)
        drawn.append(_resampled_means(_rates(results), starts[same], _weights(rng, len(results.success), resamples)))
    return np.array(drawn)


def _rates(results: ConditionResults, checkpoints: int | None = None) -> np.ndarray:
    """Success (training seeds, episodes) over the last checkpoints; over all of them if their number is not given."""
    return results.success[:, -(checkpoints or results.success.shape[1]) :].mean(1)


def _paired_rates(first: ConditionResults, second: ConditionResults) -> list[np.ndarray]:
    """Success (training seeds, episodes) of two conditions over equally many checkpoints of the same episodes."""
    if first.episode_seeds != second.episode_seeds:
        one, other = len(first.episode_seeds), len(second.episode_seeds)
        flag = "--seeds, or both without" if one == other else "--num-eval-episodes"
        raise ResultError(
            f"{first.name} and {second.name} were evaluated on different initial states, {one} and {other} of them; evaluate "
            f"both with the same {flag}"
        )
    checkpoints = min(first.success.shape[1], second.success.shape[1])
    return [_rates(side, checkpoints) for side in (first, second)]


def _weights(rng: np.random.Generator, count: int, resamples: int = RESAMPLES) -> np.ndarray:
    """How much each of `count` samples weighs in each resample (resamples, count).

    The spread of resampled means is too small by sqrt((count - 1) / count), which matters for three training seeds; the
    weights make up for it, and the sum of them stays one.
    """
    chosen = rng.integers(count, size=(resamples, count)) + count * np.arange(resamples)[:, None]
    drawn = np.bincount(chosen.ravel(), minlength=resamples * count).reshape(resamples, count) / count
    return 1 / count + (drawn - 1 / count) * np.sqrt(count / max(count - 1, 1))


def _resampled_means(rates: np.ndarray, starts: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Means (RESAMPLES,) of rates (training seeds, episodes), given the weights of the episodes and of the seeds."""
    return np.einsum("rs,se,re->r", seeds, rates, starts, optimize=True)


def _estimate(value: float, drawn: np.ndarray, of: Sequence[ConditionResults], lowest: float) -> Estimate:
    if np.ptp(drawn) < NO_SPREAD:  # without any variation, a bootstrap has nothing to draw from
        fewest = min(len(results.episode_seeds) for results in of)
        unseen = wilson_interval(0, fewest)[1]  # largest plausible rate of an outcome that no episode has shown
        return Estimate(value, max(value - unseen, lowest), min(value + unseen, 1.0))
    low, high = np.quantile(drawn, TAILS).clip(lowest, 1.0)
    return Estimate(value, float(low), float(high))
