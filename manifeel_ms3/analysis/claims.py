"""Test the paper's claims on results: `manifeel claims --results runs --out claims.md`.

Each claim is a difference of two conditions on the same initial states, with its interval of 95 % and a verdict: the claim
holds where the whole interval is above zero, does not hold where all of it is below zero, and is undecided otherwise. A claim
of no gain holds where the interval ends below 5 points and at least 10 % of the episodes of one of the two succeed, and does
not hold where it begins above 0. With fewer than three training seeds, there is no verdict. Both conditions have the same
preset of their policies and the paper's number of demonstrations, except in the claim about that number.

Interval and verdict are those of a single comparison. Of many comparisons without any difference, 5 % exclude zero by chance;
the p-values after Holm's correction for all comparisons with a verdict say which differences remain.
"""

import logging
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal

import tyro

from manifeel_ms3.arguments import require_file
from manifeel_ms3.command_line import as_typed, run
from manifeel_ms3.evaluation.result import results_in
from manifeel_ms3.files import write_text

from .condition import Condition
from .encoder_ranking import ranking_tables
from .estimates import FEWEST_SEEDS, NEAR_NO_SUCCESS, SIGNIFICANT, Estimate, difference, has_enough_seeds, holm, p_text
from .markdown import markdown_table
from .matching import Found, answering_all
from .paper import TACFF, TACSL, TWIN_RATES, paper_condition, reported, twin_condition
from .paper_claims import Comparison, comparisons
from .presets import TrainingSettings
from .protocol import collect, of_the_protocol

log = logging.getLogger(__name__)
Verdict = Literal["holds", "does not hold", "undecided", "too few seeds"]
MARGIN = 0.05
"""Largest gain in success that counts as none where a claim says that there is no gain: five points, our choice."""
MANY_TESTS = """Differences are in percentage points; "the paper" has its own. Interval, p and verdict are each of one
comparison alone. A pair of which a condition has fewer than {seeds} training seeds has no verdict ("too few seeds"), since two
runs that differ in their seed alone often differ as much; its interval is of these runs only. The table tests {pairs} of
conditions, some of them for several claims, and of many tests, 5 % find a difference where there is none. The column "p, Holm"
is corrected for all of them (Holm 1979): {remaining} of the {count} differences have a corrected p below 0.05.{reach}
"""
REACH = """ Half the width of their intervals is {points:.0f} points
in the median: a smaller difference mostly stays undecided, and "undecided" does not mean that there is none."""


@dataclass(frozen=True)
class ClaimResult:
    """Outcome of a comparison."""

    difference: Estimate
    """How much more often the first condition succeeds."""
    p_value: float | None
    """P-value of the hypothesis that both conditions succeed equally often; None with too few training seeds."""
    p_holm: float | None
    """The p-value after Holm's correction for all pairs of conditions that have one."""
    verdict: Verdict
    """Whether the claim holds, by this comparison alone."""
    settings: TrainingSettings
    """Settings that both conditions were run with."""
    conditions: frozenset[Condition]
    """The two conditions."""


def results_of_claims(found: Found) -> dict[Comparison, list[ClaimResult]]:
    """The outcomes of all comparisons, one for each set-up that both conditions were run with.

    Args:
        found: The results that enter comparisons.

    Raises:
        ResultError: Results cannot be told apart, or are of different initial states.
    """
    pairs = {
        (comparison, settings): (first, second)
        for comparison in comparisons()
        for settings, (first, second) in answering_all([comparison.first, comparison.second], found).items()
    }
    differences = {(first, second): difference(found[first], found[second]) for first, second in pairs.values()}
    tests = {  # several claims may rest on one test
        frozenset(pair): p_value
        for pair, (_, p_value) in differences.items()
        if has_enough_seeds(*(found[condition] for condition in pair))
    }
    corrected = dict(zip(tests, holm(list(tests.values())), strict=True))
    outcomes: dict[Comparison, list[ClaimResult]] = {comparison: [] for comparison in comparisons()}
    for (comparison, settings), pair in pairs.items():
        (gap, _), test = differences[pair], frozenset(pair)
        best = max(float(found[condition].success.mean()) for condition in pair)
        verdict = _verdict(comparison, gap, best) if test in tests else "too few seeds"
        outcomes[comparison].append(ClaimResult(gap, tests.get(test), corrected.get(test), verdict, settings, test))
    return outcomes


def _verdict(comparison: Comparison, gap: Estimate, best: float) -> Verdict:
    """The verdict on a claim, given the difference and the higher success of the two conditions."""
    if comparison.gain:
        return "holds" if gap.low > 0 else "does not hold" if gap.high < 0 else "undecided"
    if gap.low > 0:
        return "does not hold"
    return "holds" if gap.high < MARGIN and best >= NEAR_NO_SUCCESS else "undecided"


def claims_page(found: Found, answered: dict[Comparison, list[ClaimResult]]) -> str:
    """Markdown: a table with a row for each comparison, those that were not run included, and the ranking of encoders.

    A sentence says how many comparisons the table tests, and which p-values are corrected for their number.

    Args:
        found: The results that enter comparisons.
        answered: What `results_of_claims` makes of them.
    """
    tables, rows = _papers_rates(), []
    for comparison, outcomes in answered.items():
        what = (comparison.claim, comparison.first.task, _compared(comparison))
        papers = _papers_difference(comparison, tables)
        ran = [
            (one.difference.signed, papers, p_text(one.p_value), p_text(one.p_holm), one.verdict, one.settings)
            for one in outcomes
        ]
        rows += [(*what, *cells) for cells in ran or [(None, papers, None, None, "not run", None)]]
    names = ("claim", "task", "compared", "difference", "the paper", "p", "p, Holm", "verdict", "settings")
    table = markdown_table(names, rows)
    results = [one for outcomes in answered.values() for one in outcomes]
    tested = {one.conditions: (one.p_holm, one.difference) for one in results if one.p_holm is not None}
    remaining = sum(p_holm < SIGNIFICANT for p_holm, _ in tested.values())
    halves = [50 * (change.high - change.low) for _, change in tested.values()]
    reach = REACH.format(points=median(halves)) if halves else ""
    pairs = "1 pair" if len(tested) == 1 else f"{len(tested)} pairs"
    note = MANY_TESTS.format(seeds=FEWEST_SEEDS, pairs=pairs, count=len(tested), remaining=remaining, reach=reach)
    return f"{table}\n{note}\n{''.join(ranking_tables(found))}"


def _papers_rates() -> list[dict[Condition, float]]:
    """The rates of each of the paper's tables and of its simulated twin. The paper's TacFF has TacSL's units."""
    tables: dict[str, dict[Condition, float]] = {}
    for number, condition, rate in reported():
        rates = tables.setdefault(number, {})
        rates[condition] = rate.mean
        if condition.obs_mode == TACFF:
            rates[paper_condition(condition.task, TACFF, condition.policy, variant=TACSL)] = rate.mean
    twin = {twin_condition(task, mode): rate for task, rates in TWIN_RATES.items() for mode, rate in rates.items()}
    return [*tables.values(), twin]


def _papers_difference(comparison: Comparison, tables: Iterable[dict[Condition, float]]) -> str | None:
    """The difference in the first of the paper's tables that has both conditions, in points; None if there is none."""
    for rates in tables:
        if comparison.first in rates and comparison.second in rates:
            return f"{100 * (rates[comparison.first] - rates[comparison.second]):+.0f}"
    return None


def _compared(comparison: Comparison) -> str:
    """The properties in which the two conditions differ, and what they share.

    An encoder that both share is left out, since each preset has its own for TacRGB.
    """
    first, second = comparison.first, comparison.second
    pairs = {
        "cameras": (" ".join(first.cameras), " ".join(second.cameras)),
        "mode": (first.obs_mode, second.obs_mode),
        "policy": (first.policy, second.policy),
        "encoder": (first.encoder, second.encoder) if first.obs_mode == second.obs_mode else ("", ""),
        "demos": (f"{first.num_demos} demonstrations", f"{second.num_demos} demonstrations"),
        "variant": (first.variant or "default", second.variant or "default"),
    }
    differing = [pair for pair in pairs.values() if pair[0] != pair[1]]
    alike = [pair[0] for name, pair in pairs.items() if pair[0] == pair[1] and name != "encoder"]
    shared = [value for value in alike if value != "default"]
    over = ", ".join(one for one, _ in differing) + " over " + ", ".join(other for _, other in differing)
    return f"{over} ({', '.join(shared)})"


@dataclass
class Args:
    """Arguments of the test of claims."""

    results: tuple[Path, ...]
    """Folders with result files."""
    out: Path | None = None
    """Path of a Markdown file for the table; the table is only shown if not given."""


def main(args: Args) -> dict[Comparison, list[ClaimResult]]:
    """Test every claim whose conditions have been run.

    Raises:
        InvalidArgumentError: The path of the table is that of a folder.
        ResultError: There is no result, one is broken, or some cannot be told apart.
    """
    if args.out:
        require_file("--out", args.out, "claims.md")
    collected = collect(results_in(*args.results))
    found = of_the_protocol(collected)
    for condition, results in collected.items():
        if condition not in found:
            log.warning("%s is left out: %s", condition, results.why_left_out)
    answered = results_of_claims(found)
    text = claims_page(found, answered)
    log.info("%s", text)
    if args.out:
        write_text(args.out, text)
    return answered


def next_step(args: Args, _answers: dict[Comparison, list[ClaimResult]]) -> str:
    """What the command made, and what one can do with it."""
    page = as_typed("manifeel", "results", "--results", *args.results, "--out", "results.md")
    made = f"{args.out} has this table" if args.out else "--out FILE.md writes this table to a file"
    return f"{made}; {page} makes the page with it and all other results"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
