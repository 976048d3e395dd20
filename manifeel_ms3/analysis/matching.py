"""Find the results that correspond to a condition of the paper, and compare like with like.

A condition of the paper leaves the settings open, but all conditions of a comparison must have the same settings. Therefore
each set-up, such as the paper's preset or the small networks, has a result of its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from manifeel_ms3.evaluation.result import ResultError

from .condition import Condition
from .paper import MODES, SCRATCH, paper_condition
from .presets import TrainingSettings, has_presets_encoder, training_settings_of
from .protocol import ConditionResults

Found = Mapping[Condition, ConditionResults]


def answering(wanted: Condition, found: Found) -> dict[TrainingSettings, Condition]:
    """The conditions that correspond to one of the paper, one for each set-up.

    Args:
        wanted: A condition of the paper, without settings.
        found: The results that enter comparisons.

    Raises:
        ResultError: Two conditions correspond to it in one set-up, such as encoders that start from different weights.
    """
    answers: dict[TrainingSettings, Condition] = {}
    for condition in found:
        if as_the_paper_says(condition) == wanted:
            other = answers.setdefault(training_settings_of(condition), condition)
            if other != condition:
                apart = sorted({name for name, _ in set(condition.settings) ^ set(other.settings)})
                raise ResultError(
                    f"{other} and {condition} would both answer for one condition of the paper, and differ in {apart}; give "
                    "the folders of one of them"
                )
    return answers


def answering_all(wanted: Sequence[Condition], found: Found) -> dict[TrainingSettings, list[Condition]]:
    """The conditions that correspond to several of the paper, for each set-up that has them all, the paper's preset first."""
    answers = [answering(condition, found) for condition in wanted]
    common = set.intersection(*(set(one) for one in answers))
    in_order = sorted(common, key=lambda settings: settings.sort_key)
    return {settings: [one[settings] for one in answers] for settings in in_order}


def of_table_one(task: str, found: Found) -> dict[TrainingSettings, dict[str, Condition]]:
    """The conditions of a task of Table I that were run, by observation mode, for each set-up.

    Args:
        task: Short name of the task.
        found: The results that enter comparisons.
    """
    by_settings: dict[TrainingSettings, dict[str, Condition]] = {}
    for mode in MODES:
        for settings, condition in answering(paper_condition(task, mode), found).items():
            by_settings.setdefault(settings, {})[mode] = condition
    return by_settings


def as_the_paper_says(condition: Condition) -> Condition:
    """A condition without its settings; its preset's encoder of TacRGB is the one that is trained from scratch."""
    encoder = SCRATCH if condition.encoder and has_presets_encoder(condition) else condition.encoder
    return replace(condition, settings=(), encoder=encoder)
