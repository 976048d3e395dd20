"""How episodes end: counts of what was missing, by the rule of `EpisodeOutcome.ending`, for every condition."""

from collections import Counter
from dataclasses import dataclass
from typing import Any

from .condition import Condition, by_condition
from .markdown import markdown_table, shown

CENSUS = """
## How episodes end

Counts over all episodes of the last checkpoint of every training seed. "Lost" means that the episode could no longer succeed,
for example because a part was dropped; the other endings say what was missing at the time limit. "Pressed too hard" counts
the unsuccessful episodes whose largest contact force was above the task's limit for gentle success. In screwing, results
without "beside the axis" are older: a part beside the axis is among the others there, according to its height.

"""
Results = list[dict[str, Any]]


@dataclass(frozen=True)
class Endings:
    """How the episodes of a condition ended."""

    episodes: int
    """Number of episodes."""
    succeeded: int
    """Number of episodes that succeeded."""
    missed: list[tuple[str, int]]
    """Endings of the failed episodes, and the number of episodes with each, the most frequent first."""
    pressed_too_hard: int | None
    """Number of failed episodes with a force above the limit of gentle success; None for a task without one."""


def census_table(results: Results, conditions: list[Condition]) -> str:
    """The section of a page that counts how episodes end; "" if no result says it.

    Args:
        results: Contents of result files.
        conditions: Conditions to count, in the order of the rows.
    """
    rows, of_condition = [], by_condition(results)
    for condition in conditions:
        if endings := endings_of(of_condition.get(condition, [])):
            missed = ", ".join(f"{count} {shown(name)}" for name, count in endings.missed)
            counts = (endings.episodes, endings.succeeded, missed, endings.pressed_too_hard)
            rows.append((*map(shown, (condition.task, condition.sensing, condition.policy)), f"`{condition.key}`", *counts))
    names = ("task", "sensing", "policy", "id", "episodes", "success", "how the others end", "pressed too hard")
    return f"{CENSUS}{markdown_table(names, rows)}" if rows else ""


def endings_of(results: Results) -> Endings | None:
    """How the episodes of the last checkpoint of every training seed ended; None where the results do not say it.

    Args:
        results: Contents of the result files of one condition.
    """
    with_endings = [result for result in results if all("ending" in episode for episode in result["episodes"])]
    last: dict[Any, dict[str, Any]] = {}
    for result in sorted(with_endings, key=lambda result: result["config"].get("step", 0)):
        last[result["training_seed"]] = result
    if not last:
        return None
    episodes = [episode for result in last.values() for episode in result["episodes"]]
    missed = [episode for episode in episodes if not episode["success_once"]]
    limit = with_endings[0].get("force_limit")
    hard = None if limit is None else sum(episode["peak_contact_force"] > limit for episode in missed)
    return Endings(
        len(episodes), len(episodes) - len(missed), Counter(episode["ending"] for episode in missed).most_common(), hard
    )
