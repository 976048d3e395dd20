"""Which encoder of TacRGB is best on each task of the paper's Table III, and whether one is best on all."""

from collections.abc import Iterator
from dataclasses import dataclass

from .estimates import Estimate, difference, mean_success
from .markdown import markdown_table
from .matching import Found, answering_all
from .paper import ENCODERS, TACRGB, paper_condition, tasks_in_table
from .paper_claims import NO_ENCODER_IS_BEST
from .presets import TrainingSettings
from .protocol import ConditionResults


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
    p_value: float
    """Probability of so large a gap between the best and the second encoder if both succeed equally often."""

    @property
    def best_over_second(self) -> Estimate:
        """How much more often the best encoder succeeds than the second."""
        return self.gaps[self.encoders[0], self.encoders[1]]

    def is_beaten(self, encoder: str) -> bool:
        """Whether another encoder succeeds more often, with the whole interval of the difference above zero."""
        return any(gap.low > 0 for (_, worse), gap in self.gaps.items() if worse == encoder)


def rankings(found: Found) -> dict[TrainingSettings, list[EncoderRanking]]:
    """The rankings of all tasks of Table III on which every encoder was run, by set-up."""
    ranked: dict[TrainingSettings, list[EncoderRanking]] = {}
    for task in tasks_in_table("III"):
        names = tuple(ENCODERS[task])
        wanted = [paper_condition(task, TACRGB, encoder=name) for name in names]
        for settings, conditions in answering_all(wanted, found).items():
            results = dict(zip(names, (found[condition] for condition in conditions), strict=True))
            ranked.setdefault(settings, []).append(_ranking(task, results))
    return ranked


def _ranking(task: str, results: dict[str, ConditionResults]) -> EncoderRanking:
    success = {name: mean_success(of_encoder) for name, of_encoder in results.items()}
    order = sorted(success, key=lambda name: -success[name].value)
    compared = {
        (better, worse): difference(results[better], results[worse])
        for k, better in enumerate(order)
        for worse in order[k + 1 :]
    }
    gaps = {pair: gap for pair, (gap, _) in compared.items()}
    return EncoderRanking(task, tuple(order), tuple(success[name] for name in order), gaps, compared[order[0], order[1]][1])


def verdict_on(ranked: list[EncoderRanking]) -> str:
    """Whether no encoder is best on all tasks.

    It holds where each encoder is beaten on some task, and does not hold where one beats all the others on every task of Table
    III. One encoder beats another where the whole interval of their difference is above zero.
    """
    encoders = ranked[0].encoders
    if all(any(task.is_beaten(name) for task in ranked) for name in encoders):
        return "holds"
    best = {task.encoders[0] for task in ranked}
    beats_all = all(all(gap.low > 0 for (better, _), gap in task.gaps.items() if better == task.encoders[0]) for task in ranked)
    complete = {task.task for task in ranked} == set(tasks_in_table("III"))
    return "does not hold" if complete and len(best) == 1 and beats_all else "undecided"


def ranking_tables(found: Found) -> Iterator[str]:
    """Markdown: for each set-up, the best encoder of every task with its interval over the second, and the verdict."""
    yield f"**{NO_ENCODER_IS_BEST}**: "
    ranked = rankings(found)
    if not ranked:
        yield f"not run. It needs {', '.join(ENCODERS['GearAssembly'])} on a task of Table III.\n"
    for settings, with_settings in ranked.items():
        yield f"{verdict_on(with_settings)} (settings: {settings}).\n\n"
        names = ("task", "best", "success", "second", "success", "best over second", "p")
        yield markdown_table(names, (_row(ranking) for ranking in with_settings))
        yield "\n"


def _row(ranking: EncoderRanking) -> tuple[object, ...]:
    (best, second, *_), (of_best, of_second, *_) = ranking.encoders, ranking.success
    return ranking.task, best, of_best, second, of_second, ranking.best_over_second.signed, f"{ranking.p_value:.3f}"
