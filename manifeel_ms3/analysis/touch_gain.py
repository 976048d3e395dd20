"""What touch adds, task by task: a paragraph of numbers for each task that was run both with and without touch."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from manifeel_ms3.evaluation.gentle import is_gentle
from manifeel_ms3.evaluation.result import ResultError

from .condition import Condition, by_condition
from .episode_endings import Results, endings_of
from .estimates import NEAR_NO_SUCCESS, SIGNIFICANT, Pair, difference, has_enough_seeds, mean_difference
from .markdown import markdown_table, shown
from .matching import Found, answering, of_table_one
from .paper import DP, MODES, TABLE_I, TABLE_II, VISION, Rate, paper_condition, tasks_in_table
from .presets import TrainingSettings
from .protocol import ConditionResults

TEXT = """
## What touch adds, and how episodes fail

Changes are in percentage points against vision alone on the same initial states, with 95 % intervals. Where a condition has
fewer than three training seeds, the interval covers the initial states only and says nothing about how much training varies.
Each change is tested alone, without a correction for their number. It contradicts the paper's, which is taken as exact, where
that lies outside of its interval and one of the two conditions succeeds in at least a tenth of the episodes. How an episode
fails is determined by a rule of its task.

"""
AUDIT_TEXT = """Above the changes of a task stands what probes could tell from one moment of its demonstrations, by
camera and touch ([audit](audit.md)): the share of right answers or the error, each with its 95 % interval, and the score by
chance.

"""
MEANS_TEXT = """
### What touch adds on average

The mean change over the tasks of a category that were run with at least three training seeds of each condition, by three
measures: success at any step, as the paper counts it, success at the last step, and gentle success. Its interval is narrower
than that of a single task, and is of these tasks, not of others. "The paper" is the mean of its changes over the same tasks.

"""
MEASURES: dict[str, Callable[[dict[str, Any], float], bool | None]] = {
    "success": lambda episode, _limit: episode["success_once"],
    "at the end": lambda episode, _limit: episode.get("success_at_end"),
    "gentle success": is_gentle,
}
"""What counts as a success of an episode, given the task's limit of the contact force in N."""
NAMES: dict[str, str] = dict(zip(MODES, ("vision alone", "TacRGB", "TacFF"), strict=True))
"""Names of the observation modes in the text."""


def touch_gains(found: Found, results: list[dict[str, Any]], audit: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Markdown, part by part; nothing if no task was run both with and without touch.

    Args:
        found: The results that enter comparisons.
        results: Contents of result files.
        audit: What the information audit found, by the names of tasks.
    """
    of_condition = by_condition(results)
    tasks = dict.fromkeys((*TABLE_I, *TABLE_II))  # Table II adds sorting in normal light
    paragraphs = [text for task in tasks for text in _of_a_task(task, found, of_condition, audit.get(task, ()))]
    if paragraphs:
        yield TEXT
        if audit:
            yield AUDIT_TEXT
        yield "\n".join(paragraphs)
    if rows := list(_mean_rows(found)):
        yield MEANS_TEXT
        yield markdown_table(("category", "settings", "touch", "tasks", *MEASURES, "the paper"), rows)


def _mean_rows(found: Found) -> Iterator[tuple[Any, ...]]:
    """A row for each category, set-up and kind of touch in which two tasks or more have enough training seeds."""
    for category in ("insertion", "screwing", "exploration"):
        pairs: dict[tuple[TrainingSettings, str], dict[str, Pair]] = {}
        for task in tasks_in_table("I", category):
            seen = answering(paper_condition(task, VISION), found)
            for mode in MODES[1:]:
                for settings, touched in answering(paper_condition(task, mode), found).items():
                    if settings not in seen:
                        continue
                    pair = found[touched], found[seen[settings]]
                    if has_enough_seeds(*pair) and pair[0].episode_seeds == pair[1].episode_seeds:
                        pairs.setdefault((settings, mode), {})[task] = pair
        for (settings, mode), of_task in pairs.items():
            if len(of_task) > 1:
                papers = np.mean([rates[mode].mean - rates[VISION].mean for rates in map(_papers_rates, of_task)])
                cells = (_mean_change(list(of_task.values()), measure) for measure in MEASURES)
                yield category, settings, NAMES[mode], ", ".join(of_task), *cells, f"{100 * papers:+.0f}"


def _mean_change(pairs: Sequence[Pair], measure: str) -> str | None:
    """The mean change of a measure as text; None where an episode lacks it."""
    sides = [_measured(side, measure) for pair in pairs for side in pair]
    known = [side for side in sides if side is not None]
    if len(known) < len(sides):
        return None
    return mean_difference(list(zip(known[::2], known[1::2], strict=True)))[0].signed


def _measured(results: ConditionResults, measure: str) -> ConditionResults | None:
    """Results whose success is another measure; None where an episode, or the task's limit of the force, lacks it."""
    if measure == "gentle success" and results.force_limit is None:
        return None
    met = [MEASURES[measure](episode, results.force_limit or 0.0) for episode in results.episodes]
    return None if None in met else replace(results, success=np.array(met, float).reshape(results.success.shape))


def _papers_rates(task: str) -> dict[str, Rate]:
    """The paper's rates of Diffusion Policy by observation mode."""
    return dict(zip(MODES, TABLE_I.get(task) or TABLE_II[task][DP], strict=True))


def _of_a_task(task: str, found: Found, results: dict[Condition, Results], audit: Sequence[str]) -> Iterator[str]:
    """A paragraph for each set-up in which a task was run with vision alone and with touch, after one on its audit."""
    of_settings = of_table_one(task, found).items()
    compared = [(settings, of_mode) for settings, of_mode in of_settings if VISION in of_mode and len(of_mode) > 1]
    if compared and audit:
        yield f"**{task}**, what one moment reveals: {'; '.join(audit)}.\n"
    for settings, conditions in compared:
        gains = "; ".join(_gain(task, mode, conditions, found) for mode in conditions if mode != VISION)
        ends = " ".join(_endings(mode, results[condition]) for mode, condition in conditions.items())
        yield f"**{task}** ({settings}): {gains}. {ends}\n"


def _gain(task: str, mode: str, conditions: dict[str, Condition], found: Found) -> str:
    rates = _papers_rates(task)
    change = rates[mode].mean - rates[VISION].mean
    papers = f"the paper: {100 * change:+.0f}"
    touched, seen = found[conditions[mode]], found[conditions[VISION]]
    try:
        gain, p_value = difference(touched, seen)
    except ResultError:  # evaluated on other initial states
        return f"{NAMES[mode]} cannot be compared"
    verdict = "not significant; " if p_value >= SIGNIFICANT else ""
    if not has_enough_seeds(touched, seen):
        verdict = "too few training seeds to tell; "
    elif not gain.low <= change <= gain.high and max(touched.success.mean(), seen.success.mean()) >= NEAR_NO_SUCCESS:
        papers += ", which this contradicts"
    return f"{NAMES[mode]} changes success by {gain.signed} points ({verdict}{papers})"


def _endings(mode: str, results: Results) -> str:
    endings = endings_of(results)
    if endings is None:
        return ""
    missed = ", ".join(f"{count} {shown(name)}" for name, count in endings.missed) or "none"
    return f"With {NAMES[mode]}, {endings.episodes - endings.succeeded} of {endings.episodes} episodes fail: {missed}."
