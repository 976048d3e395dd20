"""The table of everything that was run, with what it measured, what it cost, and how it is made again."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from manifeel_ms3.evaluation.floors import highest_floor
from manifeel_ms3.evaluation.result import successes_by_the_paper

from .condition import Condition, by_condition
from .gentle_success import gentle_cell
from .markdown import markdown_table, shown
from .paper_comparison import gpu_of_training
from .paper_tables import Files, success_with_links
from .presets import row_in_a_study, training_settings_of
from .protocol import ConditionResults

SECONDS_PER_HOUR = 3600
AGAIN = """
The success rate of each run links to its result file. Where a folder `checkpoints` lies beside that file in
`leaderboard/NAME/seed0`, `manifeel eval --entry NAME` runs its episodes again and reports in how many the outcomes agree.
"""
MADE_BY = """
`manifeel study {study} --only 'ROW'`, with the last cell of a row for ROW, makes its results again, from the recording to the
evaluation; without `--only`, it makes those of all rows.
"""


def table_of_runs(
    found: dict[Condition, ConditionResults], results: list[dict[str, Any]], files: Files, study: Path | None
) -> Iterator[str]:
    """The table, and how its rows are made again, part by part.

    Args:
        found: The results by condition.
        results: Contents of the result files.
        files: Links to the result files of conditions.
        study: File of the study that makes them; None if they are of no study.
    """
    rows, of_condition = [], by_condition(results)
    for condition, here in in_order(found):
        cost, machines = _cost(of_condition[condition])
        note = f"left out: {here.why_left_out}" if here.why_left_out else None
        success = success_with_links(here, files.get(condition, ())), percent(here.success_at_end)
        measured = (
            *success,
            _floor(condition),
            gentle_cell(here),
            _by_the_paper(here),
            percent(here.seed_deviation),
            here.size,
            note,
        )
        network = shown(condition.policy), shown(condition.encoder)
        of = (*network, condition.num_demos, training_settings_of(condition), f"`{condition.key}`")
        again = [] if study is None else [_code(row_in_a_study(condition))]
        rows.append((task_with_revision(condition), shown(condition.sensing), *measured, *of, cost, machines, *again))
    measures = ("success", "at the end", "floor", "gentle success", "by the paper's threshold", "std", "of", "note")
    settings = ("policy", "TacRGB encoder", "demonstrations", "settings", "id")
    yield markdown_table(
        ("task", "sensing", *measures, *settings, "cost", "on", *([] if study is None else ["row in the study"])), rows
    )
    yield AGAIN
    if study is not None:
        yield MADE_BY.format(study=study.as_posix())


def _code(text: str | None) -> str | None:
    """A text as code of Markdown, if it is safe there."""
    return f"`{text}`" if text is not None and shown(text) == text else None


def _by_the_paper(results: ConditionResults) -> str | None:
    """Share of the episodes that met the threshold of the paper's public code, over the training seeds that measured it."""
    count, size = len(results.success), len(results.episodes) // len(results.success)
    of_seeds = [successes_by_the_paper(results.episodes[k * size : (k + 1) * size]) for k in range(count)]
    measured = [successes for successes in of_seeds if successes is not None]
    if not measured:
        return None
    return f"{np.mean(measured):.0%}" + (f", {len(measured)} of {count} seeds" if len(measured) < count else "")


def _floor(condition: Condition) -> str | None:
    floor = highest_floor(condition.env_id, condition.revision, condition.variant)
    return floor and str(floor)


def percent(rate: float | None) -> str | None:
    """A rate in whole percent; None if there is none."""
    return None if rate is None else f"{rate:.0%}"


def in_order(found: dict[Condition, ConditionResults]) -> list[tuple[Condition, ConditionResults]]:
    """Conditions with their results, in the order of their fields."""
    return sorted(found.items(), key=lambda item: tuple(map(str, vars(item[0]).values())))


def task_with_revision(condition: Condition) -> str:
    """The task of a condition, its arguments and its revision, as Markdown."""
    revision = f"revision {condition.revision}" if condition.revision > 1 else ""
    variant = shown(condition.variant)
    code = f"`{variant}`" if variant and variant == condition.variant else variant
    return " ".join(filter(None, (shown(condition.task), code, revision)))


def _cost(results: list[dict[str, Any]]) -> tuple[str | None, str | None]:
    """Hours of training and the machines that trained, as text; None for a policy that was not trained."""
    longest: dict[Any, float] = {}
    machines = set()
    for result in results:
        config = result["config"]
        seed = result["training_seed"]
        longest[seed] = max(longest.get(seed, 0.0), config.get("training_seconds", 0.0))
        if trained_on := config.get("trained_on"):
            machines.add(shown(gpu_of_training(config) or f"{trained_on['cores']} cores of an {trained_on['cpu']}"))
    hours = sum(longest.values()) / SECONDS_PER_HOUR
    return f"{hours:.2f} h" if hours else None, ", ".join(sorted(machines)) or None
