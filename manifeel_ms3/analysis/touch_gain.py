"""What touch adds, task by task: a paragraph of numbers for each task that was run both with and without touch."""

from collections.abc import Iterator
from typing import Any

from manifeel_ms3.evaluation.result import ResultError

from .condition import Condition, by_condition
from .episode_endings import Results, endings_of
from .estimates import SIGNIFICANT, difference, has_enough_seeds
from .matching import Found, answering
from .paper import MODES, TABLE_I, VISION, Rate, paper_condition
from .presets import TrainingSettings

TEXT = """
## What touch adds, and how episodes fail

Changes are in percentage points against vision alone on the same initial states, with 95 % intervals. Where a condition has
fewer than three training seeds, the interval covers the initial states only and says nothing about how much training varies.
How an episode fails is determined by a rule of its task. The [audit](audit.md) shows how much the camera and touch can reveal
at all.

"""
NAMES: dict[str, str] = dict(zip(MODES, ("vision alone", "TacRGB", "TacFF"), strict=True))
"""Names of the observation modes in the text."""


def touch_gains(found: Found, results: list[dict[str, Any]]) -> Iterator[str]:
    """Markdown, part by part; nothing if no task was run both with and without touch.

    Args:
        found: The results that enter comparisons.
        results: Contents of result files.
    """
    of_condition = by_condition(results)
    paragraphs = [text for task in TABLE_I for text in _of_a_task(task, found, of_condition)]
    if paragraphs:
        yield TEXT
        yield "\n".join(paragraphs)


def _of_a_task(task: str, found: Found, results: dict[Condition, Results]) -> Iterator[str]:
    """A paragraph for each set-up in which a task was run with vision alone and with touch."""
    by_settings: dict[TrainingSettings, dict[str, Condition]] = {}
    for mode in MODES:
        for settings, condition in answering(paper_condition(task, mode), found).items():
            by_settings.setdefault(settings, {})[mode] = condition
    for settings, conditions in by_settings.items():
        if VISION in conditions and len(conditions) > 1:
            gains = "; ".join(_gain(task, mode, conditions, found) for mode in conditions if mode != VISION)
            ends = " ".join(_endings(mode, results[condition]) for mode, condition in conditions.items())
            yield f"**{task}** ({settings}): {gains}. {ends}\n"


def _gain(task: str, mode: str, conditions: dict[str, Condition], found: Found) -> str:
    rates: dict[str, Rate] = dict(zip(MODES, TABLE_I[task], strict=True))
    papers = f"the paper: {100 * (rates[mode].mean - rates[VISION].mean):+.0f}"
    touched, seen = found[conditions[mode]], found[conditions[VISION]]
    try:
        gain, p_value = difference(touched, seen)
    except ResultError:  # evaluated on other initial states
        return f"{NAMES[mode]} cannot be compared"
    verdict = "not significant; " if p_value >= SIGNIFICANT else ""
    if not has_enough_seeds(touched, seen):
        verdict = "too few training seeds to tell; "
    return f"{NAMES[mode]} changes success by {gain.signed} points ({verdict}{papers})"


def _endings(mode: str, results: Results) -> str:
    endings = endings_of(results)
    if endings is None:
        return ""
    missed = ", ".join(f"{count} {name}" for name, count in endings.missed) or "none"
    return f"With {NAMES[mode]}, {endings.episodes - endings.succeeded} of {endings.episodes} episodes fail: {missed}."
