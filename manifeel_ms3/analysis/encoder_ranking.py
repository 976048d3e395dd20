"""Which encoder of TacRGB is best on each task of the paper's Table III, and whether one is best on all.

The best and the second encoder are named by the same results that then compare them, so that the gap between them is rather
too large. Therefore every two encoders are compared on every task, and the p-values are corrected for all these comparisons.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

from .estimates import SIGNIFICANT, Estimate, difference, has_enough_seeds, holm, mean_success, p_text
from .markdown import markdown_table
from .matching import Found, answering_all
from .paper import TABLE_III, TACRGB, paper_condition, tasks_in_table
from .paper_claims import NO_ENCODER_IS_BEST
from .presets import TrainingSettings
from .protocol import ConditionResults

CHOSEN_AFTERWARDS = """Best and second are named by the results themselves, so that the gap between them and its interval are
rather too large. The p-values and the verdict are corrected for the comparisons of every two encoders on all tasks (Holm 1979).
"""


@dataclass(frozen=True)
class EncoderRanking:
    """The encoders of one task, from the best to the worst."""

    task: str
    """Short name of the task."""
    encoders: tuple[str, ...]
    """Names of the encoders by their success, the highest first."""
    success: tuple[Estimate, ...]
    """Success of each of `encoders`."""
    gaps: dict[tuple[str, str], Estimate]
    """How much more often the first of two encoders succeeds than the second; for every two, the better one first."""
    p_values: dict[tuple[str, str], float]
    """P-values of `gaps`, after Holm's correction for every two encoders on all tasks of the set-up; none of pairs that have
    too few training seeds."""

    @property
    def best_over_second(self) -> Estimate:
        """How much more often the best encoder succeeds than the second."""
        return self.gaps[self.encoders[0], self.encoders[1]]

    def beats(self, better: str, worse: str) -> bool:
        """Whether one encoder succeeds more often than another, with a corrected p-value below 5 %."""
        return self.p_values.get((better, worse), 1.0) < SIGNIFICANT

    def is_beaten(self, encoder: str) -> bool:
        """Whether another encoder beats this one."""
        return any(self.beats(other, encoder) for other in self.encoders)


def rankings(found: Found) -> dict[TrainingSettings, list[EncoderRanking]]:
    """The rankings of all tasks of Table III on which every encoder was run, by set-up."""
    ran: dict[TrainingSettings, dict[str, dict[str, ConditionResults]]] = {}
    for task in tasks_in_table("III"):
        names = tuple(TABLE_III[task])
        wanted = [paper_condition(task, TACRGB, encoder=name) for name in names]
        for settings, conditions in answering_all(wanted, found).items():
            results = dict(zip(names, (found[condition] for condition in conditions), strict=True))
            ran.setdefault(settings, {})[task] = results
    return {settings: _rankings(of_tasks) for settings, of_tasks in ran.items()}


def _rankings(of_tasks: dict[str, dict[str, ConditionResults]]) -> list[EncoderRanking]:
    """The rankings of the tasks of one set-up, from the results of each encoder on each task."""
    success = {task: {name: mean_success(one) for name, one in results.items()} for task, results in of_tasks.items()}
    order = {task: sorted(rates, key=lambda name: -rates[name].value) for task, rates in success.items()}
    compared = {
        (task, pair): difference(*(of_tasks[task][name] for name in pair))
        for task, names in order.items()
        for pair in combinations(names, 2)
    }
    tested = [of for of in compared if has_enough_seeds(*(of_tasks[of[0]][name] for name in of[1]))]
    corrected = dict(zip(tested, holm([compared[of][1] for of in tested]), strict=True))
    return [
        EncoderRanking(
            task,
            tuple(names),
            tuple(success[task][name] for name in names),
            {pair: compared[task, pair][0] for pair in combinations(names, 2)},
            {pair: corrected[task, pair] for pair in combinations(names, 2) if (task, pair) in corrected},
        )
        for task, names in order.items()
    ]


def verdict_on(ranked: list[EncoderRanking]) -> str:
    """Whether no encoder is best on all tasks.

    It holds where each encoder is beaten on some task, and does not hold where one beats all the others on every task of Table
    III. One encoder beats another where it succeeds more often and their corrected p-value is below 5 %.
    """
    encoders = ranked[0].encoders
    if all(any(task.is_beaten(name) for task in ranked) for name in encoders):
        return "holds"
    best = {task.encoders[0] for task in ranked}
    beats_all = all(task.beats(task.encoders[0], other) for task in ranked for other in task.encoders[1:])
    complete = {task.task for task in ranked} == set(tasks_in_table("III"))
    return "does not hold" if complete and len(best) == 1 and beats_all else "undecided"


def ranking_tables(found: Found) -> Iterator[str]:
    """Markdown: for each set-up, the best encoder of every task with its lead over the second, and the verdict."""
    yield f"**{NO_ENCODER_IS_BEST}**: "
    ranked = rankings(found)
    if not ranked:
        yield f"not run. It needs {', '.join(TABLE_III['GearAssembly'])} on a task of Table III.\n"
    for settings, with_settings in ranked.items():
        yield f"{verdict_on(with_settings)} (settings: {settings}).\n\n"
        names = ("task", "best", "success", "second", "success", "best over second, points", "p, Holm")
        yield markdown_table(names, (_row(ranking) for ranking in with_settings))
        yield f"\n{CHOSEN_AFTERWARDS}"


def _row(ranking: EncoderRanking) -> tuple[object, ...]:
    (best, second, *_), (of_best, of_second, *_) = ranking.encoders, ranking.success
    p_value = p_text(ranking.p_values.get((best, second)))
    return ranking.task, best, of_best, second, of_second, ranking.best_over_second.signed, p_value
