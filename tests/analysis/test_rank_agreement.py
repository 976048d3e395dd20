"""Ranks are compared as scipy and SimplerEnv do, and appear on the page of results once there is something to rank."""

import re

import numpy as np
import pytest

from manifeel_ms3.analysis.paper import MODES, TABLE_II, paper_condition
from manifeel_ms3.analysis.protocol import ConditionResults
from manifeel_ms3.analysis.rank_agreement import Ranked, agreement_of, mean_tau, rank_violation

from .made_up import text_of, write_run

ALL = [[0, 1, 2, 3]]
PAPER = np.array([0.1, 0.2, 0.4, 0.8])


def ranked(rates: list[float], task: str = "PegInsertion") -> list[Ranked]:
    rng = np.random.default_rng(0)
    found = []
    for mode, paper, rate in zip((*MODES, "rgb"), PAPER, rates, strict=True):
        success = (rng.random((3, 10, 50)) < rate).astype(float)
        found.append(Ranked(paper_condition(task, mode), paper, ConditionResults(success, list(range(50)))))
    return found


def test_the_same_order_agrees_and_the_reverse_does_not():
    ours = np.array([0.0, 0.3, 0.5, 0.6])
    assert (mean_tau(PAPER, ours, ALL), rank_violation(PAPER, ours, ALL)) == (1.0, 0.0)
    assert mean_tau(PAPER, -ours, ALL) == -1.0
    assert rank_violation(PAPER, -ours, ALL) == pytest.approx((0.7 + 0.6 + 0.4 + 0.7) / 4)  # the widest gap of each


def test_one_wrong_pair_costs_its_gap_in_the_paper():
    ours = np.array([0.3, 0.2, 0.5, 0.6])  # the first two, 0.1 apart in the paper, have changed places
    assert mean_tau(PAPER, ours, ALL) == pytest.approx(4 / 6)  # five pairs of six agree, one does not
    assert rank_violation(PAPER, ours, ALL) == pytest.approx((0.1 + 0.1) / 4)


def test_groups_are_compared_within_themselves():
    ours = np.array([0.7, 0.8, 0.1, 0.2])  # wrong between the groups, right within each
    assert mean_tau(PAPER, ours, [[0, 1], [2, 3]]) == 1.0
    assert rank_violation(PAPER, ours, [[0, 1], [2, 3]]) == 0.0
    assert mean_tau(PAPER, np.full(4, 0.5), ALL) == 0.0  # nothing is ranked
    equal = rank_violation(PAPER, np.full(4, 0.5), ALL)  # each is not below those that are above it in the paper
    assert equal == pytest.approx((0.7 + 0.6 + 0.4 + 0.0) / 4)


def test_intervals_hold_the_value_and_shrink_with_what_is_certain():
    tau, violation = agreement_of(ranked([0.1, 0.4, 0.7, 0.95]), ALL)
    assert (tau.value, tau.low, tau.high) == (1.0, 1.0, 1.0)
    assert violation.high == 0.0
    tau, violation = agreement_of(ranked([0.5, 0.5, 0.5, 0.5]), ALL)
    assert tau.low < 0 < tau.high
    assert violation.low <= violation.value <= violation.high
    assert violation.high > 0.3


def test_single_runs_have_no_interval_of_agreement():
    single = [
        Ranked(one.condition, one.paper, ConditionResults(one.results.success[:1], list(range(50))))
        for one in ranked([0.1, 0.4, 0.7, 0.95])
    ]
    assert [str(measure) for measure in agreement_of(single, ALL)] == ["1.00", "0.00"]


def test_the_page_ranks_three_conditions_or_more(tmp_path):
    for mode, rate in zip(MODES, (0.2, 0.3, 0.6), strict=True):
        if (tmp_path / "runs").exists():  # one or two conditions
            assert "## Ranks" not in text_of(tmp_path / "runs")
        for seed in range(3):
            write_run(tmp_path / "runs", mode, rate, seed, checkpoints=3)
    page = text_of(tmp_path / "runs")
    assert "| I | paper | within tasks | 3 | 1.00 [" in page
    assert "| 0.00 [0.00, " in page


def test_tables_whose_conditions_do_not_differ_in_what_they_compare_are_not_ranked(tmp_path):
    for mode, rate in zip(MODES, (0.2, 0.3, 0.6), strict=True):
        write_run(tmp_path, mode, rate, task="GearAssembly")
    page = text_of(tmp_path)
    assert "| I | paper | within tasks | 3 |" in page
    assert "| II | " not in page
    write_run(tmp_path, MODES[0], 0.4, task="GearAssembly", policy="flow_matching")
    page = text_of(tmp_path)
    assert "| II | paper | within tasks | 4 |" in page
    table = page.partition("### Table II, ")[2].partition("\n##")[0]
    rows = [line.split(" | ") for line in table.splitlines() if line.startswith("| GearAssembly | ")]
    shown = {
        policy: [re.sub(r"[\[\]]", "", cell).split("%")[0].split(" / ")[0] for cell in cells[:3]] for _, policy, *cells in rows
    }
    assert shown == dict(diffusion_policy=["20", "30", "60"], flow_matching=["40", "not run", "not run"])
    papers = {policy: [cell.split(" / ")[1] for cell in cells[:3]] for _, policy, *cells in rows}
    assert papers == {policy: list(map(str, TABLE_II["GearAssembly"][policy])) for policy in shown}
