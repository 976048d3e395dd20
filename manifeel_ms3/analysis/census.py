"""How episodes end: counts of what was missing, by the rule of `EpisodeOutcome.ending`, for every condition."""

from collections import Counter
from typing import Any

from .condition import Condition, condition_of
from .markdown import markdown_table

CENSUS = """
## How episodes end

Counts over all episodes of the last checkpoint of every training seed. "lost": the episode could not be won any more, such as a
part that was dropped. The others are what was missing at the time limit. "Pressed too hard" counts episodes of any ending but
success whose largest contact force was above the task's limit for gentle success.

"""
Results = list[dict[str, Any]]


def census_table(results: Results, conditions: list[Condition]) -> str:
    """The section of a page that counts how episodes end; "" where no result says it.

    Args:
        results: Contents of result files.
        conditions: Conditions to count, in the order of the rows.
    """
    told = _last_of_each_seed(results)
    rows = [_row(condition, list(told[condition].values())) for condition in conditions if condition in told]
    names = ("task", "sensing", "policy", "id", "episodes", "success", "how the others end", "pressed too hard")
    return f"{CENSUS}{markdown_table(names, rows)}" if rows else ""


def _last_of_each_seed(results: Results) -> dict[Condition, dict[Any, dict[str, Any]]]:
    """The results of the last checkpoints that say how episodes ended, by condition and training seed."""
    last: dict[Condition, dict[Any, dict[str, Any]]] = {}
    for result in sorted(results, key=lambda result: result["config"].get("step", 0)):
        if all("ending" in episode for episode in result["episodes"]):
            last.setdefault(condition_of(result), {})[result["training_seed"]] = result
    return last


def _row(condition: Condition, results: Results) -> tuple[Any, ...]:
    episodes = [episode for result in results for episode in result["episodes"]]
    missed = [episode for episode in episodes if not episode["success_once"]]
    endings = Counter(episode["ending"] for episode in missed).most_common()
    limit = results[0].get("force_limit")
    hard = None if limit is None else sum(episode["peak_contact_force"] > limit for episode in missed)
    told = ", ".join(f"{count} {name}" for name, count in endings)
    counts = (len(episodes), len(episodes) - len(missed), told, hard)
    return (condition.task, condition.sensing, condition.policy, f"`{condition.key}`", *counts)
