"""Check of whether an episode that is run again has the outcome that a result holds."""

from typing import Any

from .rollout import EpisodeOutcome, outcome_as_json

FORCE_TOLERANCE = 0.01
"""Largest difference in N between forces that count as equal; a result rounds them to 0.001 N."""
FORCES = ("peak_contact_force", "force_until_success")
"""Entries of an episode that are forces."""
COMPARED = ("success_once", "success_at_end", "fail_once", "fail_at_end", "first_success", "episode_len", *FORCES)
"""Entries of an episode that must agree when it is run again."""
NOT_IN_OLD_RESULTS = "success_paper"
"""Entry that must agree, too, in an episode that has it."""


def differences(episode: dict[str, Any], outcome: EpisodeOutcome) -> list[str]:
    """What differs between an episode of a result and the same episode run again, as sentences; [] where they agree."""
    found, again = [], outcome_as_json(outcome)
    is_old = episode.get(NOT_IN_OLD_RESULTS) is None
    for name in COMPARED if is_old else (*COMPARED, NOT_IN_OLD_RESULTS):
        tolerance = FORCE_TOLERANCE if name in FORCES else 0
        before, now = episode.get(name), again.get(name)
        differs = before is not now if before is None or now is None else abs(before - now) > tolerance
        if differs:
            found.append(f"{name} says {before}, run again it is {now}")
    return found
