"""Test the paper's claims on results: `python -m manifeel_ms3.analysis.claims --results runs --out claims.md`.

Each claim is a difference of two conditions on the same initial states, with its interval of 95 % and a verdict: the claim
holds where the whole interval is above zero, does not hold where all of it is below zero, and is undecided otherwise.
"""

import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, permutations
from pathlib import Path
from typing import Literal

import tyro

from manifeel_ms3.command_line import run
from manifeel_ms3.evaluation.result import results_in
from manifeel_ms3.files import write_text

from .markdown import markdown_table
from .paper import ENCODERS, EQUIDP, FM, MODES, TACFF, TACRGB, VISION, paper_condition, tasks_in_table
from .protocol import PAPER_NETWORK, Condition, ConditionResults, Estimate, collect, difference

log = logging.getLogger(__name__)
Verdict = Literal["holds", "does not hold", "undecided"]
MARGIN = 0.05
"""Largest gain in success that counts as none where a claim says that there is no gain: five points, our choice."""


@dataclass(frozen=True)
class Comparison:
    """A claim about two conditions of one task."""

    claim: str
    """Number of the claim, and its text."""
    first: Condition
    second: Condition
    gain: bool = True
    """Whether the claim is that the first condition succeeds more often; otherwise, that it does not."""


@dataclass(frozen=True)
class ClaimResult:
    """Outcome of a comparison."""

    comparison: Comparison
    difference: Estimate
    """How much more often the first condition succeeds."""
    p_value: float
    """Probability of such a difference if there is none (paired permutation test)."""
    verdict: Verdict
    network: str
    """Encoder of camera images that both conditions were run with."""


def comparisons() -> Iterator[Comparison]:
    """All comparisons of the paper's claims; `num_demos` is left open where a claim does not speak of it."""
    return chain(_touch_claims(), _policy_claims(), _encoder_claims(), _demonstration_claims(), _camera_claims())


def _touch_claims() -> Iterator[Comparison]:
    for task in tasks_in_table("I", "insertion", "screwing"):
        claim = "1. TacFF beats vision where parts fit"
        yield Comparison(claim, paper_condition(task, TACFF), paper_condition(task, VISION))
    for task in tasks_in_table("I", "exploration"):
        claim = "2. TacRGB beats vision where the task is to explore"
        yield Comparison(claim, paper_condition(task, TACRGB), paper_condition(task, VISION))
    for task in ("GearAssembly", "NutBoltAssembly", "BulbInstallation"):
        claim = "3. TacRGB does not beat vision on gear, nut and bulb"
        yield Comparison(claim, paper_condition(task, TACRGB), paper_condition(task, VISION), gain=False)


def _policy_claims() -> Iterator[Comparison]:
    for task in tasks_in_table("II"):
        for mode in MODES:
            claim = "4. Flow Matching is below Diffusion Policy"
            yield Comparison(claim, paper_condition(task, mode), paper_condition(task, mode, FM))
    for task in tasks_in_table("II", "insertion", "screwing"):
        for mode in MODES:
            claim = "5. The equivariant policy is above on gear and bulb"
            yield Comparison(claim, paper_condition(task, mode, EQUIDP), paper_condition(task, mode))
    for task in tasks_in_table("II", "exploration"):
        for mode in MODES:
            claim = "5. The equivariant policy is below on search and sorting"
            yield Comparison(claim, paper_condition(task, mode), paper_condition(task, mode, EQUIDP))


def _encoder_claims() -> Iterator[Comparison]:
    for task in tasks_in_table("III"):
        for pair in permutations(ENCODERS[task], 2):
            first, second = (paper_condition(task, TACRGB, encoder=name) for name in pair)
            yield Comparison("6. Tactile encoders differ by task", first, second)


def _demonstration_claims() -> Iterator[Comparison]:
    gear = {count: paper_condition("GearAssembly", TACFF, num_demos=count) for count in (40, 80, 100)}
    yield Comparison("7. Success grows up to about 80 demonstrations", gear[80], gear[40])
    yield Comparison("7. Success saturates near 80 demonstrations", gear[100], gear[80], gain=False)


def _camera_claims() -> Iterator[Comparison]:
    for mode in (VISION, TACRGB):
        wrist, front = (paper_condition("ObjectSearch", mode, camera=camera) for camera in ("wrist", "front"))
        yield Comparison("8. The wrist camera is above the front camera in object search", wrist, front)
    for camera in ("wrist", "front"):
        with_touch, without = (paper_condition("ObjectSearch", mode, camera=camera) for mode in (TACRGB, VISION))
        yield Comparison("8. TacRGB helps from both viewpoints", with_touch, without)


def result_of_claim(comparison: Comparison, found: dict[Condition, ConditionResults]) -> ClaimResult | None:
    """The outcome of a comparison; None where one of its conditions was not run."""
    results, network = find_with_one_network([comparison.first, comparison.second], found)
    if not results:
        return None
    gap, p_value = difference(*results)
    return ClaimResult(comparison, gap, p_value, _verdict(comparison, gap), network)


def results_of_claims(found: dict[Condition, ConditionResults]) -> dict[Comparison, ClaimResult | None]:
    """The outcomes of all comparisons; None for those that were not run."""
    return {comparison: result_of_claim(comparison, found) for comparison in comparisons()}


def find(wanted: Condition, found: dict[Condition, ConditionResults]) -> ConditionResults | None:
    """The results of a condition; where it leaves the number of demonstrations open, those with the most demonstrations."""
    fitting = [other for other in found if wanted == (other if wanted.num_demos else replace(other, num_demos=None))]
    return found[max(fitting, key=lambda other: other.num_demos or 0)] if fitting else None


def find_with_one_network(
    wanted: list[Condition], found: dict[Condition, ConditionResults]
) -> tuple[list[ConditionResults], str]:
    """The results of conditions that were all run with the same network, and its name.

    The network is the paper's if all conditions were run with it, else another one. Without such a network the list is empty.
    """
    for network in sorted({other.network for other in found}, key=lambda network: (network != PAPER_NETWORK, network)):
        results = [find(replace(side, network=network), found) for side in wanted]
        complete = [side for side in results if side is not None]
        if len(complete) == len(wanted):
            return complete, network
    return [], ""


def _verdict(comparison: Comparison, gap: Estimate) -> Verdict:
    if comparison.gain:
        return "holds" if gap.low > 0 else "does not hold" if gap.high < 0 else "undecided"
    return "holds" if gap.high < MARGIN else "does not hold" if gap.low > 0 else "undecided"


def claims_table(results: dict[Comparison, ClaimResult | None]) -> str:
    """A Markdown table with a row for each comparison, those that were not run included."""
    rows = []
    for comparison, found in results.items():
        outcome = (None, None, "not run", None)
        if found:
            outcome = (found.difference.signed, f"{found.p_value:.3f}", found.verdict, found.network)
        rows.append((comparison.claim, comparison.first.task, _compared(comparison), *outcome))
    return markdown_table(("claim", "task", "compared", "difference", "p", "verdict", "network"), rows)


def _compared(comparison: Comparison) -> str:
    """The first property in which the two conditions differ, and what they share."""
    pairs = zip(vars(comparison.first).values(), vars(comparison.second).values(), strict=True)
    shared = " ".join(filter(None, (comparison.first.policy, comparison.first.obs_mode)))
    differing = [pair for pair in pairs if pair[0] != pair[1] and all(pair)]
    first, second = (", ".join(value) if isinstance(value, tuple) else str(value) for value in differing[0])
    return f"{first} over {second} ({shared})"


@dataclass
class Args:
    """Arguments of the test of claims."""

    results: tuple[Path, ...]
    """Folders with result files."""
    out: Path | None = None
    """Path of a Markdown file for the table; the table is only shown if not given."""


def main(args: Args) -> dict[Comparison, ClaimResult | None]:
    """Test every claim whose conditions have been run.

    Raises:
        ResultError: There is no result, or one is broken.
    """
    results = results_of_claims(collect(results_in(*args.results)))
    log.info("%s", claims_table(results))
    if args.out:
        write_text(args.out, claims_table(results))
    return results


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
