"""What the paper claims, against what has been run: `python -m manifeel_ms3.analysis.claims --results runs --out claims.md`.

Each claim is a difference of two set-ups on the same starts, with its interval of 95 % and a verdict: it holds where the whole
interval is above zero, does not where all of it is below, and is undecided otherwise.
"""

import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Literal

import tyro

from manifeel_ms3.command_line import run
from manifeel_ms3.evaluation.result import results_in
from manifeel_ms3.files import write_text

from .markdown import markdown_table
from .paper import ENCODERS, EQUIDP, FM, TACFF, TACRGB, VISION, setup
from .protocol import PAPER_NETWORK, Estimate, Runs, Setup, collect, difference

log = logging.getLogger(__name__)
Verdict = Literal["holds", "does not hold", "undecided"]
MARGIN = 0.05  # of success: a gain that is smaller counts for none, where a claim says that there is none
FORCE_TASKS = ("PegInsertion", "USBInsertion", "PowerPlugInsertion", "GearAssembly", "NutBoltAssembly", "BulbInstallation")
EXPLORATION = ("PegReorientation", "ObjectSearch", "BallSortingDim")


@dataclass(frozen=True)
class Comparison:
    """A claim about two set-ups of one task: the first succeeds more often, or, with `gain=False`, not more often."""

    claim: str
    first: Setup
    second: Setup
    gain: bool = True


@dataclass(frozen=True)
class Answer:
    comparison: Comparison
    difference: Estimate
    p_value: float
    verdict: Verdict
    network: str


def comparisons() -> Iterator[Comparison]:
    """The paper's claims. `num_demos` is left open where a claim does not speak of it."""
    for task in FORCE_TASKS:
        yield Comparison("1. TacFF beats vision where parts fit", setup(task, TACFF), setup(task, VISION))
    for task in EXPLORATION:
        yield Comparison("2. TacRGB beats vision where it explores", setup(task, TACRGB), setup(task, VISION))
    for task in ("GearAssembly", "NutBoltAssembly", "BulbInstallation"):
        claim = "3. TacRGB does not beat vision on gear, nut and bulb"
        yield Comparison(claim, setup(task, TACRGB), setup(task, VISION), gain=False)
    for task in ("GearAssembly", "BulbInstallation", "ObjectSearch", "BallSorting"):
        for mode in (VISION, TACRGB, TACFF):
            yield Comparison("4. Flow Matching is below Diffusion Policy", setup(task, mode), setup(task, mode, FM))
    for task in ("GearAssembly", "BulbInstallation"):
        for mode in (VISION, TACRGB, TACFF):
            claim = "5. The equivariant policy is above on gear and bulb"
            yield Comparison(claim, setup(task, mode, EQUIDP), setup(task, mode))
    for task in ("ObjectSearch", "BallSorting"):
        for mode in (VISION, TACRGB, TACFF):
            claim = "5. The equivariant policy is below on search and sorting"
            yield Comparison(claim, setup(task, mode), setup(task, mode, EQUIDP))
    for task in ("GearAssembly", "ObjectSearch", "BallSorting"):
        for one, other in permutations(ENCODERS[task], 2):
            first, second = (setup(task, TACRGB, encoder=name) for name in (one, other))
            yield Comparison("6. Tactile encoders differ by task", first, second)
    gear = {count: setup("GearAssembly", TACFF, num_demos=count) for count in (40, 80, 100)}
    yield Comparison("7. Success grows up to about 80 demonstrations", gear[80], gear[40])
    yield Comparison("7. Success saturates near 80 demonstrations", gear[100], gear[80], gain=False)
    for mode in (VISION, TACRGB):
        wrist, front = (setup("ObjectSearch", mode, camera=camera) for camera in ("wrist", "front"))
        yield Comparison("8. The wrist camera is above the front camera in object search", wrist, front)
    for camera in ("wrist", "front"):
        with_touch, without = (setup("ObjectSearch", mode, camera=camera) for mode in (TACRGB, VISION))
        yield Comparison("8. TacRGB helps from both viewpoints", with_touch, without)


def answer(comparison: Comparison, found: dict[Setup, Runs]) -> Answer | None:
    """What was run says; None where it was not."""
    runs, network = find_alike([comparison.first, comparison.second], found)
    if not runs:
        return None
    gap, p_value = difference(*runs)
    return Answer(comparison, gap, p_value, _verdict(comparison, gap), network)


def answers_of(found: dict[Setup, Runs]) -> dict[Comparison, Answer | None]:
    return {comparison: answer(comparison, found) for comparison in comparisons()}


def find(wanted: Setup, found: dict[Setup, Runs]) -> Runs | None:
    """The runs of a set-up; where it leaves the number of demonstrations open, those with the most."""
    alike = [other for other in found if wanted == (other if wanted.num_demos else replace(other, num_demos=None))]
    return found[max(alike, key=lambda other: other.num_demos or 0)] if alike else None


def find_alike(wanted: list[Setup], found: dict[Setup, Runs]) -> tuple[list[Runs], str]:
    """The runs of set-ups with one network, and which: the paper's, or else another that all of them were run with; none if
    there is no such."""
    for network in sorted({other.network for other in found}, key=lambda network: (network != PAPER_NETWORK, network)):
        runs = [find(replace(side, network=network), found) for side in wanted]
        if None not in runs:
            return runs, network
    return [], ""


def _verdict(comparison: Comparison, gap: Estimate) -> Verdict:
    if comparison.gain:
        return "holds" if gap.low > 0 else "does not hold" if gap.high < 0 else "undecided"
    return "holds" if gap.high < MARGIN else "does not hold" if gap.low > 0 else "undecided"


def table(answers: dict[Comparison, Answer | None]) -> str:
    """Markdown: a row a comparison; those not run say so."""
    rows = []
    for comparison, found in answers.items():
        said = (None, None, "not run", None)
        if found:
            said = (found.difference.signed, f"{found.p_value:.3f}", found.verdict, found.network)
        rows.append((comparison.claim, comparison.first.task, _named(comparison), *said))
    return markdown_table(("claim", "task", "compared", "difference", "p", "verdict", "network"), rows)


def _named(comparison: Comparison) -> str:
    """What differs between the two."""
    pairs = zip(vars(comparison.first).values(), vars(comparison.second).values(), strict=True)
    shared = " ".join(filter(None, (comparison.first.policy, comparison.first.obs_mode)))
    differing = [(a, b) for a, b in pairs if a != b and a and b]
    a, b = differing[0]
    named = [", ".join(x) if isinstance(x, tuple) else str(x) for x in (a, b)]
    return f"{named[0]} over {named[1]} ({shared})"


@dataclass
class Args:
    results: tuple[Path, ...]
    """folders with result files"""
    out: Path | None = None
    """Markdown to write; default: shown only"""


def main(args: Args) -> dict[Comparison, Answer | None]:
    """Answer every claim that has been run.

    Raises:
        ResultError: there is no result, or one is broken.
    """
    answers = answers_of(collect(results_in(*args.results)))
    log.info("%s", table(answers))
    if args.out:
        write_text(args.out, table(answers))
    return answers


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
