"""Means and intervals of the protocol, against cases whose answer is known."""

import json

import numpy as np
import pytest

from manifeel_ms3.analysis.protocol import Condition, ConditionResults, collect, condition_of, difference, mean_success
from manifeel_ms3.evaluation.result import ResultError, result_of, results_in
from tests.conftest import PEG
from tests.outcomes import made_up

RNG = np.random.default_rng(0)


def runs(rate: float, seeds: int = 3, episodes: int = 50) -> ConditionResults:
    return ConditionResults((RNG.random((seeds, 10, episodes)) < rate).astype(float), list(range(episodes)))


def write(folder, seed: int, step: int, won: list[bool], **changes) -> None:
    config = dict(policy_name="diffusion_policy", obs_mode="rgb+tacrgb", seed=seed, step=step, num_demos=50)
    config |= dict(policy=dict(encoder=dict(image="resnet18", tacrgb="t3")))
    outcomes = [made_up(100 + k, win) for k, win in enumerate(won)]
    result = result_of(PEG, dict(cameras=["wrist"]), config, outcomes) | changes
    path = folder / f"{seed}/{step:08d}.json"
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_text(json.dumps(result))


def test_runs_are_collected_by_condition_and_the_last_checkpoints_count(tmp_path):
    for seed in (0, 1):
        for step in (10, 20, 30):
            write(tmp_path, seed, step, [step == 30, step >= 20, seed == 1])
    collected = collect(results_in(tmp_path), last=2)
    (condition,) = collected
    assert condition == Condition(PEG, "rgb+tacrgb", "diffusion_policy", "t3", ("wrist",), 50)
    assert collected[condition].episode_seeds == [100, 101, 102]
    assert collected[condition].success.tolist() == [[[0, 1, 0], [1, 1, 0]], [[0, 1, 1], [1, 1, 1]]]
    assert mean_success(collected[condition]).value == pytest.approx(8 / 12)


def test_what_renders_is_no_part_of_a_condition_but_what_changes_the_task_is():
    config = dict(policy_name="diffusion_policy", obs_mode="tacff")
    plain, rendered, changed = (
        condition_of(result_of(PEG, env_kwargs, config, [made_up(1, True)]))
        for env_kwargs in (
            dict(sim_backend="physx_cpu"),
            dict(render_backend="none", sensor_configs=dict(width=128), tactile_sensors=["left"]),
            dict(fit="loose"),
        )
    )
    assert rendered == plain
    assert plain.variant == ""
    assert changed.variant == '{"fit": "loose"}'


def test_results_of_different_initial_states_are_not_mixed(tmp_path):
    write(tmp_path, 0, 10, [True, False])
    write(tmp_path, 1, 10, [True])
    with pytest.raises(ResultError, match="different initial states"):
        collect(results_in(tmp_path))
    with pytest.raises(ResultError, match="different initial states"):
        difference(runs(0.5, episodes=10), runs(0.5, episodes=12))


def test_one_checkpoint_has_wilsons_interval():
    never = ConditionResults(np.zeros((1, 1, 50)), list(range(50)))
    assert mean_success(never).low == 0.0
    assert mean_success(never).high == pytest.approx(1.96**2 / (50 + 1.96**2), rel=1e-3)  # Wilson (1927), at no success


def test_interval_is_that_of_the_mean_over_seeds():
    """Against the standard error of the seeds' means: with many seeds, the percentile bootstrap comes near the normal one."""
    many = runs(0.4, seeds=200)
    means = many.success.mean((1, 2))
    half = 1.96 * means.std(ddof=1) / np.sqrt(len(means))
    estimate = mean_success(many)
    assert estimate.value == pytest.approx(means.mean())
    assert estimate.low == pytest.approx(means.mean() - half, abs=0.15 * half)
    assert estimate.high == pytest.approx(means.mean() + half, abs=0.15 * half)


def test_tasks_weigh_the_same_however_many_seeds_they_have():
    assert mean_success(runs(0.2, seeds=30), runs(0.8, seeds=3)).value == pytest.approx(0.5, abs=0.03)


def test_a_difference_is_found_where_there_is_one():
    found, p = difference(runs(0.7), runs(0.3))
    assert found.low > 0.3
    assert found.high < 0.5
    assert p < 0.01
    none, p = difference(runs(0.5), runs(0.5))
    assert none.low < 0 < none.high
    assert p > 0.05


def test_initial_states_are_compared_one_by_one():
    """Initial states differ far more than conditions do; what is paired still sees a small difference."""
    hard = RNG.random(50)
    base = np.tile(hard, (3, 10, 1))
    first, second = (
        ConditionResults((RNG.random(base.shape) < base + shift).astype(float), list(range(50))) for shift in (0.06, -0.06)
    )
    found, p = difference(first, second)
    assert found.low > 0
    assert p < 0.01


def test_what_never_varied_in_a_few_episodes_may_yet():
    """Nothing in n episodes bounds what is unseen by Wilson's upper limit at no success, z^2 / (n + z^2)."""

    def always(episodes: int, won: int = 1) -> ConditionResults:
        return ConditionResults(np.full((3, 10, episodes), float(won)), list(range(episodes)))

    unseen = 1.96**2 / (50 + 1.96**2)
    assert mean_success(always(50)) == mean_success(always(50), always(50))
    assert (mean_success(always(50)).low, mean_success(always(50)).high) == (pytest.approx(1 - unseen, rel=1e-3), 1.0)
    same, p = difference(always(50, 0), always(50, 0))
    assert (same.value, same.low, same.high) == (0.0, pytest.approx(-unseen, rel=1e-3), pytest.approx(unseen, rel=1e-3))
    assert p == 1.0
    assert mean_success(always(2, 0)).high > 0.6
