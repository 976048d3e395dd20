"""Claims are answered from result files, and only where both sides were run."""

import json
import re

import numpy as np
import pytest

from manifeel_ms3.analysis import claims, results_page
from manifeel_ms3.analysis.protocol import Estimate, collect
from manifeel_ms3.evaluation.result import ResultError, result_of, results_in
from tests.conftest import PEG
from tests.outcomes import made_up


def write_run(folder, mode: str, rate: float, seed: int, policy="diffusion_policy", network="resnet18") -> None:
    """Ten checkpoints of a policy on PegInsertion."""
    rng = np.random.default_rng([seed, len(mode)])
    for step in range(10):
        config = dict(policy_name=policy, obs_mode=mode, seed=seed, step=step, num_demos=50)
        config |= dict(policy=dict(encoder=dict(image=network)))
        won = rng.random(50) < rate
        outcomes = [made_up(k, bool(win)) for k, win in enumerate(won)]
        path = folder / policy / network / mode / str(seed) / f"evaluations/{step:08d}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(result_of(PEG, dict(cameras=["wrist"]), config, outcomes)))


def test_a_claim_that_was_run_is_answered_and_the_others_say_so(tmp_path):
    for seed in range(3):
        write_run(tmp_path, "rgb", 0.2, seed)
        write_run(tmp_path, "rgb+tacff", 0.5, seed)
    answers = claims.main(claims.Args((tmp_path,), tmp_path / "claims.md"))
    answered = [found for found in answers.values() if found]
    assert len(answered) == 1
    assert answered[0].comparison.claim.startswith("1.")
    assert answered[0].verdict == "holds"
    assert answered[0].difference.value == pytest.approx(0.3, abs=0.05)
    page = (tmp_path / "claims.md").read_text()
    assert "| PegInsertion | rgb+tacff over rgb (diffusion_policy rgb+tacff) | +3" in page
    assert page.count("not run") == len(answers) - 1


def test_the_page_of_results_holds_what_was_run_beside_the_papers(tmp_path):
    write_run(tmp_path, "rgb", 0.2, 0)
    page = results_page.main(results_page.Args((tmp_path,), tmp_path / "results.md")).read_text()
    ran, reported = (line for line in page.splitlines() if "1 x 10 x 50" in line)
    assert ran.startswith("| PegInsertion | rgb wrist | diffusion_policy |")
    assert reported.startswith("| I | PegInsertion | rgb | diffusion_policy |  | 14% |")
    assert "| I | USBInsertion | rgb | diffusion_policy |  | 49% | not run |" in page
    assert "learnt nothing" not in page


def test_gains_over_policies_that_learnt_nothing_are_shown(tmp_path):
    write_run(tmp_path, "rgb", 0.6, 0)
    write_run(tmp_path, "none", 0.0, 0, policy="MeanAction", network="")
    page = results_page.main(results_page.Args((tmp_path,), tmp_path / "results.md")).read_text()
    assert "| PegInsertion | rgb wrist | diffusion_policy | MeanAction | +6" in page


def test_small_networks_are_named_and_never_compared_with_the_papers(tmp_path):
    write_run(tmp_path, "rgb", 0.2, 0)
    write_run(tmp_path, "rgb+tacff", 0.5, 0, network="small_cnn")
    assert not any(claims.results_of_claims(collect(results_in(tmp_path))).values())
    write_run(tmp_path, "rgb", 0.2, 0, network="small_cnn")
    page = results_page.main(results_page.Args((tmp_path,), tmp_path / "results.md")).read_text()
    assert re.search(r"\| I \| PegInsertion \| rgb\+tacff .* 40% .* small_cnn \|", page)
    assert re.search(r"rgb\+tacff over rgb .* holds \| small_cnn \|", page)


@pytest.mark.parametrize(
    ("gain", "interval", "verdict"),
    [
        (True, (0.02, 0.2), "holds"),
        (True, (-0.02, 0.2), "undecided"),
        (True, (-0.2, -0.02), "does not hold"),
        (False, (-0.1, 0.04), "holds"),
        (False, (-0.1, 0.1), "undecided"),
        (False, (0.01, 0.1), "does not hold"),
    ],
)
def test_verdicts(gain, interval, verdict):
    comparison = next(c for c in claims.comparisons() if c.gain is gain)
    assert claims._verdict(comparison, Estimate(sum(interval) / 2, *interval)) == verdict


def test_all_eight_claims_of_the_paper_are_asked():
    assert {comparison.claim[0] for comparison in claims.comparisons()} == set("12345678")


def test_folders_without_results_are_named(tmp_path):
    with pytest.raises(ResultError, match="--eval-episodes 50"):
        claims.main(claims.Args((tmp_path,)))
