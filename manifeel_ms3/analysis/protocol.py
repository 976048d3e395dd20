"""The paper's protocol: success is the mean over the last ten checkpoints, all episodes and training seeds of a condition."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from manifeel_ms3.evaluation.result import ResultError

from .condition import Condition, condition_of

log = logging.getLogger(__name__)
LAST = 10
"""Number of checkpoints at the end of training that a mean is taken over (the paper's protocol)."""
FEWEST_EPISODES = 50
"""Number of episodes of the paper's protocol. A result with fewer has another purpose, and enters no comparison."""
FEWEST_STEPS = 2000
"""Number of gradient steps of the shortest preset. A run with fewer has another purpose, and enters no comparison."""
Run = TypeVar("Run")
Outcomes = dict[int, dict[str, Any]]
"""Episodes of a result file, by their seeds."""


@dataclass
class ConditionResults:
    """Success of one condition in every evaluated episode."""

    success: np.ndarray
    """1 where an episode succeeded, else 0: (training seeds, checkpoints, episodes)."""
    episode_seeds: list[int]
    """Seeds of the episodes, which set their initial states; the same for all checkpoints."""
    trained_steps: int | None = None
    """Gradient steps of the last checkpoint, of the training seed that has the fewest; None for a policy that names none."""
    planned_steps: int | None = None
    """Gradient steps that its training was to have; None if the results do not say it."""
    episodes: list[dict[str, Any]] = field(default_factory=list)
    """The episodes of `success` as their result files have them, in the same order."""
    force_limit: float | None = None
    """The task's limit of the contact force for gentle success when it was evaluated, in N; None without one."""
    name: str = "a condition"
    """What messages call the condition."""

    @property
    def size(self) -> str:
        """Text with the numbers of training seeds, checkpoints and episodes, such as "3 x 10 x 50"."""
        return " x ".join(map(str, self.success.shape))

    @property
    def why_left_out(self) -> str:
        """Why the condition enters no comparison, such as "300 gradient steps"; "" if it does."""
        episodes, trained, planned = len(self.episode_seeds), self.trained_steps, self.planned_steps
        if episodes < FEWEST_EPISODES:
            return f"{episodes} episodes"
        if trained is not None and trained < FEWEST_STEPS:
            return f"{trained} gradient steps"
        if trained is not None and planned is not None and trained < planned:
            return f"stopped at step {trained} of {planned}"
        return ""

    @property
    def success_at_end(self) -> float | None:
        """Share of the episodes in which the task is solved at the last step; None where some ended at success."""
        solved = self._solved_at_end()
        return None if solved is None else float(solved.mean())

    @property
    def seed_deviation(self) -> float | None:
        """Standard deviation of the success over the training seeds; None for a single one."""
        return _deviation(self.success)

    @property
    def seed_deviation_at_end(self) -> float | None:
        """The same of the success at the last step; None where that is not known, too."""
        solved = self._solved_at_end()
        return None if solved is None else _deviation(solved)

    def _solved_at_end(self) -> np.ndarray | None:
        """1 where an episode is solved at its last step, else 0, as `success`; None where some ended at success."""
        solved = [episode.get("success_at_end") for episode in self.episodes]
        return None if not solved or None in solved else np.array(solved, float).reshape(self.success.shape)


def _deviation(solved: np.ndarray) -> float | None:
    """Standard deviation over the training seeds of the rate of (training seeds, checkpoints, episodes)."""
    rates = solved.mean((1, 2))
    return float(rates.std(ddof=1)) if len(rates) > 1 else None


def collect(results: Mapping[Path, dict[str, Any]], last: int = LAST) -> dict[Condition, ConditionResults]:
    """The results of each condition.

    Args:
        results: Contents of result files by their paths, one for each checkpoint.
        last: Largest number of checkpoints at the end of training that count.

    A result with fewer than `FEWEST_EPISODES` episodes is left out, with a warning, if its condition has results with more.

    Raises:
        ResultError: The results of a condition are of different episodes, or two of them are of the same checkpoint.
    """
    results = _without_short_ones(results)
    found: dict[Condition, dict[int | None, dict[int, Outcomes]]] = {}
    files: dict[tuple[Condition, int | None, int], Path] = {}
    planned: dict[Condition, int] = {}
    limits: dict[Condition, float] = {}
    for path, result in results.items():
        outcomes = {episode["seed"]: episode for episode in result["episodes"]}
        condition, seed, step = condition_of(result), result["training_seed"], result["config"].get("step", 0)
        steps = found.setdefault(condition, {}).setdefault(seed, {})
        if step in steps:
            raise ResultError(
                f"two results of {condition} are of training seed {seed} and step {step}: {files[condition, seed, step]}, with "
                f"{len(steps[step])} episodes, and {path}, with {len(outcomes)}; move the one that is not to count elsewhere"
            )
        steps[step], files[condition, seed, step] = outcomes, path
        if isinstance(total := result["config"].get("total_steps"), int):
            planned[condition] = max(planned.get(condition, 0), total)
        if (limit := result.get("force_limit")) is not None:
            limits[condition] = limit
    return {
        condition: replace(
            _stacked(condition, by_seed, last, planned.get(condition), files),
            force_limit=limits.get(condition),
            name=str(condition),
        )
        for condition, by_seed in found.items()
    }


def _without_short_ones(results: Mapping[Path, dict[str, Any]]) -> dict[Path, dict[str, Any]]:
    """The results but for those with too few episodes for the protocol whose condition also has results with enough."""
    short = {path: condition_of(result) for path, result in results.items() if len(result["episodes"]) < FEWEST_EPISODES}
    if not short:
        return dict(results)
    enough = {condition_of(result) for path, result in results.items() if path not in short}
    left_out = [path for path, condition in short.items() if condition in enough]
    for path in left_out:
        episodes = len(results[path]["episodes"])
        log.warning("%s is left out: it has %d episodes, and others of its condition more", path, episodes)
    return {path: result for path, result in results.items() if path not in left_out}


def in_order_of_seeds(runs: Mapping[int | None, Run]) -> list[Run]:
    """What runs are known by their training seeds, in the order of the seeds; one without a seed comes first."""
    return [runs[seed] for seed in sorted(runs, key=lambda seed: -1 if seed is None else seed)]


def of_the_protocol(found: dict[Condition, ConditionResults]) -> dict[Condition, ConditionResults]:
    """The conditions that enter comparisons: those with enough episodes whose training is over, and was no short trial."""
    return {condition: results for condition, results in found.items() if not results.why_left_out}


def _stacked(
    condition: Condition,
    by_seed: dict[int | None, dict[int, Outcomes]],
    last: int,
    planned: int | None,
    files: Mapping[tuple[Condition, int | None, int], Path],
) -> ConditionResults:
    checkpoints = min(last, *(len(steps) for steps in by_seed.values()))
    evaluated = [[steps[step] for step in sorted(steps)[-checkpoints:]] for steps in in_order_of_seeds(by_seed)]
    seeds = sorted(evaluated[0][0])
    if any(sorted(outcomes) != seeds for run in evaluated for outcomes in run):
        counts = {
            str(files[condition, seed, step]): len(steps[step])
            for seed, steps in by_seed.items()
            for step in sorted(steps)[-checkpoints:]
        }
        raise ResultError(
            f"the results of {condition} are of different initial states (files and numbers of episodes: {counts}); evaluate "
            "all of them with the same --num-eval-episodes or --seeds, or move those that are not to count elsewhere"
        )
    episodes = [outcomes[seed] for run in evaluated for outcomes in run for seed in seeds]
    success = np.array([episode["success_once"] for episode in episodes], float)
    trained = min(max(steps) for steps in by_seed.values())
    shape = len(evaluated), checkpoints, len(seeds)
    return ConditionResults(success.reshape(shape), seeds, trained or None, planned, episodes)
