"""Do our results rank the paper's conditions as the paper does? Kendall's tau, and SimplerEnv's mean maximum rank violation.

Kendall's tau (tau-b, scipy) is 1 for the same order and -1 for the reverse. The mean maximum rank violation (MMRV; Li et al.
2024, "Evaluating Real-World Robot Manipulation Policies in Simulation", section IV) is 0 for the same order: for each condition
it takes the other one that is ranked wrongly against it by the widest margin in the paper, and it is the mean of these margins.

Over all conditions of a table, the order is mostly that of the tasks' difficulty. Within tasks, it is that of what a table
compares: sensing, policies or encoders. Intervals are from a bootstrap over our training seeds and initial states; the paper's
rates are taken as they are.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import kendalltau

from .condition import Condition
from .estimates import TAILS, Estimate, resampled_success
from .markdown import markdown_table
from .matching import Found, answering
from .paper import reported
from .presets import TrainingSettings
from .protocol import ConditionResults

FEWEST = 3
"""Smallest number of conditions whose order is compared."""
NO_INTERVAL = (math.nan, math.nan)
"""Ends of the interval of a measure that has none."""
RESAMPLES = 1000
"""Number of resamples of an interval; fewer than for a rate, since each takes an order of all conditions."""
TEXT = """
## Ranks

Whether our results rank the paper's conditions as the paper does, by Kendall's tau (1: the same order, -1: the reverse) and
the mean maximum rank violation (MMRV; 0: the same order), with 95 % intervals from a bootstrap over our training seeds and
initial states; conditions with one training seed add no variation over training to it, and there is no interval where most
have only one. "Within tasks" compares only conditions of the same task, so that the agreement does not merely reflect how
difficult the tasks are.

"""


COMPARED = {"I": "obs_mode", "II": "policy", "III": "encoder"}
"""Attribute of a condition that each table of the paper compares."""


@dataclass(frozen=True)
class Ranked:
    """A condition that the paper reports and that was run here."""

    condition: Condition
    paper: float
    """The paper's success rate."""
    results: ConditionResults


class Agreement(Estimate):
    """A measure of agreement with its interval of 95 %, NaN if it has none; it is not a share, and not written in percent."""

    def __str__(self) -> str:
        interval = "" if math.isnan(self.low) else f" [{self.low:.2f}, {self.high:.2f}]"
        return f"{self.value:.2f}{interval}"


def rank_table(found: Found) -> str:
    """Markdown: agreement for each table of the paper and each set-up with enough conditions; "" if there is none.

    Args:
        found: The results that enter comparisons.
    """
    rows = [
        (table, settings, scope, len(ranked), *agreement_of(ranked, groups))
        for table, settings, conditions in _ranked_by_table(found)
        for scope, ranked, groups in _scopes(conditions)
        if len(ranked) >= FEWEST
    ]
    names = ("table", "settings", "compared", "conditions", "Kendall's tau", "MMRV")
    return f"{TEXT}{markdown_table(names, rows)}" if rows else ""


def agreement_of(ranked: Sequence[Ranked], groups: Sequence[Sequence[int]]) -> tuple[Agreement, Agreement]:
    """Kendall's tau and the mean maximum rank violation, each within groups of conditions.

    Args:
        ranked: The conditions.
        groups: Indices of the conditions that are compared with each other, of two or more each.
    """
    paper = np.array([one.paper for one in ranked])
    ours = np.array([one.results.success.mean() for one in ranked])
    if 2 * sum(len(one.results.success) == 1 for one in ranked) > len(ranked):  # little says how much they vary with the seed
        values = mean_tau(paper, ours, groups), rank_violation(paper, ours, groups)
        return Agreement(values[0], *NO_INTERVAL), Agreement(values[1], *NO_INTERVAL)
    drawn = resampled_success([(one.condition.env_id, one.results) for one in ranked], RESAMPLES)
    tau = _with_interval(lambda rates: mean_tau(paper, rates, groups), ours, drawn)
    return tau, _with_interval(lambda rates: rank_violation(paper, rates, groups), ours, drawn)


def mean_tau(paper: np.ndarray, ours: np.ndarray, groups: Sequence[Sequence[int]]) -> float:
    """Mean of Kendall's tau over groups. A group in which all of ours, or all of the paper's, are equal counts as 0.

    Args:
        paper: The paper's success rates (conditions,).
        ours: Our success rates (conditions,).
        groups: Indices of the conditions that are compared with each other.
    """
    found = [kendalltau(paper[list(group)], ours[list(group)])[0] for group in groups]
    return float(np.mean(np.nan_to_num(found)))


def rank_violation(paper: np.ndarray, ours: np.ndarray, groups: Sequence[Sequence[int]]) -> float:
    """The mean maximum rank violation over all conditions, each compared with those of its group.

    Args:
        paper: The paper's success rates (conditions,).
        ours: Our success rates (conditions,).
        groups: Indices of the conditions that are compared with each other.
    """
    worst = []
    for group in groups:
        theirs, here = paper[list(group)], ours[list(group)]
        violated = (here[:, None] < here) != (theirs[:, None] < theirs)
        worst.append((np.abs(theirs[:, None] - theirs) * violated).max(1))
    return float(np.mean(np.concatenate(worst)))


def _with_interval(measure: Callable[[np.ndarray], float], ours: np.ndarray, drawn: np.ndarray) -> Agreement:
    """The measure of our rates (conditions,), with its interval over resampled rates (conditions, resamples)."""
    value = measure(ours)
    low, high = np.quantile([measure(rates) for rates in drawn.T], TAILS)
    return Agreement(value, min(float(low), value), max(float(high), value))


def _ranked_by_table(found: Found) -> Iterator[tuple[str, TrainingSettings, list[Ranked]]]:
    """The conditions of each table that were run, by their set-up; the paper's preset is first.

    A table is left out where its conditions do not differ in what it compares.
    """
    by_table: dict[str, dict[TrainingSettings, list[Ranked]]] = {}
    for table, wanted, rate in reported():
        for settings, condition in answering(wanted, found).items():
            by_table.setdefault(table, {}).setdefault(settings, []).append(Ranked(condition, rate.mean, found[condition]))
    for table, all_settings in by_table.items():
        for settings in sorted(all_settings, key=lambda one: one.sort_key):
            if len({getattr(one.condition, COMPARED[table]) for one in all_settings[settings]}) > 1:
                yield table, settings, all_settings[settings]


def _scopes(conditions: list[Ranked]) -> Iterator[tuple[str, list[Ranked], list[list[int]]]]:
    """What is compared with what: all conditions with each other, and those of each task with each other."""
    tasks = [one.condition.env_id for one in conditions]
    if len(set(tasks)) > 1:
        yield "all conditions", conditions, [list(range(len(conditions)))]
    several = [one for one in conditions if tasks.count(one.condition.env_id) > 1]
    env_ids = [one.condition.env_id for one in several]
    groups = [[i for i, env_id in enumerate(env_ids) if env_id == task] for task in dict.fromkeys(env_ids)]
    yield "within tasks", several, groups
