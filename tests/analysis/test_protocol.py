"""Means and intervals of the protocol, against cases whose answer is known."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from manifeel_ms3.analysis.condition import NO_SETTINGS, Condition, condition_of, settings_of
from manifeel_ms3.analysis.episode_endings import census_table
from manifeel_ms3.analysis.estimates import (
    _weights,
    difference,
    has_enough_seeds,
    holm,
    mean_difference,
    mean_success,
    resampled_success,
)
from manifeel_ms3.analysis.protocol import ConditionResults, collect
from manifeel_ms3.evaluation.result import ResultError, result_of, results_in
from manifeel_ms3.evaluation.variant import variant_of
from manifeel_ms3.tasks.registry import task_spec
from tests.outcomes import made_up
from tests.tasks_and_marks import PEG

from .made_up import config_of


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator of each test's own, so that no test's draws depend on those before it."""
    return np.random.default_rng(1)


def runs(rng: np.random.Generator, rate: float, seeds: int = 3, episodes: int = 50) -> ConditionResults:
    return ConditionResults((rng.random((seeds, 10, episodes)) < rate).astype(float), list(range(episodes)))


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
    settings, revision = (("policy.encoder.image", '"resnet18"'),), task_spec(PEG).revision
    expected = Condition(PEG, "rgb+tacrgb", "diffusion_policy", "t3", ("wrist",), ("right",), 50, "", revision, settings)
    assert condition == expected
    assert collected[condition].episode_seeds == [100, 101, 102]
    assert collected[condition].success.tolist() == [[[0, 1, 0], [1, 1, 0]], [[0, 1, 1], [1, 1, 1]]]
    assert mean_success(collected[condition]).value == pytest.approx(8 / 12)
    (tmp_path / "1/00000010.json").unlink()  # of a run that began to save later
    assert collect(results_in(tmp_path))[condition].success.tolist() == collected[condition].success.tolist()
    assert collected[condition].trained_steps == 30
    (tmp_path / "1/00000030.json").unlink()  # of a run that ended sooner than the other
    assert collect(results_in(tmp_path))[condition].trained_steps == 20


def test_the_endings_of_the_last_checkpoints_are_counted(tmp_path):
    for seed in (0, 1):
        for step in (10, 20):
            write(tmp_path, seed, step, [step == 20, False, False])
            path = tmp_path / f"{seed}/{step:08d}.json"
            result = json.loads(path.read_text())
            for episode, ending in zip(result["episodes"], ["success", "lost", "beside or above the hole"], strict=True):
                episode["ending"] = ending
            for k in (0, 2):  # the first one succeeds in the last checkpoints
                result["episodes"][k]["peak_contact_force"] = 1000.0
            path.write_text(json.dumps(result))
    conditions, results = list(collect(results_in(tmp_path))), list(results_in(tmp_path).values())
    *_, row = census_table(results, conditions).splitlines()
    assert row.endswith("| 6 | 2 | 2 lost, 2 beside or above the hole | 2 |")
    for result in results:
        del result["episodes"][0]["ending"]
    assert census_table(results, conditions) == ""


def test_what_renders_is_no_part_of_a_condition_but_what_changes_the_task_is():
    config = dict(policy_name="diffusion_policy", obs_mode="tacff")
    plain, rendered, changed = (
        condition_of(result_of(PEG, env_kwargs, config, [made_up(1, True)]))
        for env_kwargs in (
            dict(sim_backend="physx_cpu"),
            dict(render_backend="none", lighting="normal"),  # a default that is spelled out
            dict(fit="tight"),
        )
    )
    assert rendered == plain
    assert plain.variant == ""
    assert changed.variant == '{"fit": "tight"}'
    assert condition_of(result_of(PEG, dict(cameras=["wrist"]), config, [made_up(1, True)])) == plain  # it sees touch alone
    sensed = [dict(tactile_sensors=["left"]), dict(sensor_configs=dict(width=128)), dict(tactile=dict(units="tacsl"))]
    results = (result_of(PEG, env_kwargs, config, [made_up(1, True)]) for env_kwargs in sensed)
    assert len({plain.key, changed.key, *(condition_of(result).key for result in results)}) == 5


def test_arguments_that_are_given_as_the_task_has_them_anyway_make_no_variant():
    own = dict(max_episode_steps=240, control_mode="pd_ee_delta_pose_fixed_gripper", imperfections={}, fit="paper")
    assert variant_of(PEG, own) == ""
    assert variant_of(PEG, own | dict(max_episode_steps=239)) == '{"max_episode_steps": 239}'
    bulb = "ManiFeel-BulbInstallation-v1"
    held = dict(start="holder", control_mode=task_spec(bulb).control_mode(dict(start="holder")))
    assert variant_of(bulb, held) == variant_of(bulb, dict(start="holder")) == '{"start": "holder"}'


def test_one_camera_and_one_pad_may_be_given_by_their_names():
    config = dict(policy_name="diffusion_policy", obs_mode="rgb+tacff")
    by_name, in_lists = (
        condition_of(result_of(PEG, dict(cameras=cameras, tactile_sensors=pads), config, [made_up(1, True)]))
        for cameras, pads in (("wrist", "left"), (["wrist"], ["left"]))
    )
    assert (by_name.cameras, by_name.pads) == (in_lists.cameras, in_lists.pads) == (("wrist",), ("left",))


def test_demonstrations_of_another_variant_make_another_policy():
    def trained_on(**recorded) -> Condition:
        config = dict(policy_name="diffusion_policy", obs_mode="rgb", env_kwargs=recorded)
        return condition_of(result_of(PEG, dict(lighting="dim"), config, [made_up(1, True)]))

    assert trained_on(lighting="dim").settings == ()
    assert trained_on().settings == (("trained on", ""),)
    assert trained_on(lighting="dim", fit="tight").settings == (("trained on", '{"fit": "tight", "lighting": "dim"}'),)


def test_what_is_written_down_beside_the_settings_makes_no_other_policy():
    config = config_of("diffusion_policy", "paper", "PegInsertion", "rgb", 0)
    settings = dict(settings_of(config, "rgb"))
    assert settings == dict(settings_of({name: value for name, value in config.items() if name not in NO_SETTINGS}, "rgb"))
    expected = {"image_size", "steps", "lr", "batch_size", "inference_steps", "policy.action_horizon", "policy.encoder.image"}
    assert expected <= set(settings)
    assert not any("tacrgb" in name or "force_field" in name for name in settings)  # without effect on what sees no touch
    assert "policy.encoder.freeze_tacrgb" in dict(settings_of(config, "rgb+tacrgb"))


def test_a_run_of_several_processes_is_of_another_condition_than_one_that_does_not_name_them():
    config = config_of("diffusion_policy", "paper", "PegInsertion", "rgb", 0)
    alone, together = (dict(settings_of(config | dict(num_processes=count), "rgb")) for count in (1, 2))
    assert alone == dict(settings_of(config, "rgb"))
    assert together == alone | {"num_processes": "2"}


def test_a_run_that_predicts_targets_is_of_another_condition_than_one_that_does_not_say_what_it_predicts():
    config = config_of("diffusion_policy", "paper", "PegInsertion", "rgb", 0)
    named, targets = (config | dict(policy=config["policy"] | dict(action_form=form)) for form in ("delta", "target"))
    older = config | dict(policy={name: value for name, value in config["policy"].items() if name != "action_form"})
    assert settings_of(older, "rgb") == settings_of(named, "rgb")
    assert dict(settings_of(targets, "rgb")) == dict(settings_of(older, "rgb")) | {"policy.action_form": '"target"'}


def test_a_length_in_epochs_needs_no_smallest_number_of_steps():
    """A policy of another package may have settings by the same names, and not all of them."""
    (steps,) = (value for name, value in settings_of(dict(steps=None, epochs=5), "rgb") if name == "steps")
    assert steps == '"5 epochs, at least 1"'


def test_a_short_run_beside_the_others_is_left_out_and_named(tmp_path, caplog):
    for seed, episodes in ((0, 50), (1, 50), (2, 20)):
        write(tmp_path, seed, 10, [True] * episodes)
    (results,) = collect(results_in(tmp_path)).values()
    assert results.success.shape == (2, 1, 50)
    assert "2/00000010.json is left out: it has 20 episodes, and others of its condition more" in caplog.text


def test_results_of_different_initial_states_are_not_mixed(tmp_path, rng):
    write(tmp_path, 0, 10, [True, False])
    write(tmp_path, 1, 10, [True])
    files = r"0/00000010\.json': 2, '.*1/00000010\.json': 1}"
    with pytest.raises(ResultError, match=rf"different initial states \(files and numbers of episodes: .*{files}"):
        collect(results_in(tmp_path))
    with pytest.raises(ResultError, match="different initial states"):
        difference(runs(rng, 0.5, episodes=10), runs(rng, 0.5, episodes=12))
    private = replace(runs(rng, 0.5, episodes=10), episode_seeds=[200_000 + k for k in range(10)])
    with pytest.raises(ResultError, match="10 and 10 of them; evaluate both with the same --seeds, or both without"):
        difference(runs(rng, 0.5, episodes=10), private)


def test_one_checkpoint_has_wilsons_interval():
    never = ConditionResults(np.zeros((1, 1, 50)), list(range(50)))
    assert mean_success(never).low == 0.0
    assert mean_success(never).high == pytest.approx(1.96**2 / (50 + 1.96**2), rel=1e-3)  # Wilson (1927), at no success


@pytest.mark.parametrize("along", ["seeds", "starts"])
def test_interval_is_that_of_what_varies(along, rng):
    """Against the normal interval of the mean, where success depends on the training seed alone, or on the start alone."""
    rates = rng.random(200) < 0.4
    axis = dict(seeds=(200, 1, 1), starts=(1, 1, 200))[along]
    varied = np.broadcast_to(rates.astype(float).reshape(axis), (200, 10, 200))
    half = 1.96 * rates.std(ddof=1) / np.sqrt(200)
    estimate = mean_success(ConditionResults(varied, list(range(200))))
    assert estimate.value == pytest.approx(rates.mean())
    assert estimate.low == pytest.approx(rates.mean() - half, abs=0.1 * half)
    assert estimate.high == pytest.approx(rates.mean() + half, abs=0.1 * half)


def test_seeds_widen_the_interval_of_a_difference():
    """Ten seeds and fifty starts whose effects are known: the intervals hold the true difference, which is none."""
    rng, held, half_widths = np.random.default_rng(1), 0, []
    for _ in range(100):
        seed_effects, starts = rng.normal(0, 0.1, (2, 10, 1, 1)), rng.uniform(0.2, 0.8, 50)
        sides = ((rng.random((10, 3, 50)) < starts + effect).astype(float) for effect in seed_effects)
        found, p = difference(*(ConditionResults(side, list(range(50))) for side in sides))
        held += found.low <= 0 <= found.high
        assert (p < 0.05) == (not found.low <= 0 <= found.high) or abs(p - 0.05) < 0.01
        half_widths.append((found.high - found.low) / 2)
    expected = 1.96 * np.sqrt(2 * 0.1**2 / 10)  # of the seeds' effects alone
    assert held >= 88  # of 100 intervals of 95 %
    assert expected < np.mean(half_widths) < 1.5 * expected


def test_the_deviation_over_seeds_is_that_of_their_means(rng):
    success = np.stack([np.full((10, 50), rate) for rate in (0.2, 0.4, 0.6)])
    assert ConditionResults(success, list(range(50))).seed_deviation == pytest.approx(0.2)
    assert runs(rng, 0.5, seeds=1).seed_deviation is None


def test_a_difference_takes_as_many_checkpoints_from_both():
    early_and_late = np.concatenate([np.zeros((1, 9, 50)), np.ones((1, 1, 50))], axis=1)
    late = np.ones((1, 1, 50))
    found, _ = difference(*(ConditionResults(side, list(range(50))) for side in (early_and_late, late)))
    assert found.value == 0.0


def test_tasks_weigh_the_same_however_many_seeds_they_have(rng):
    assert mean_success(runs(rng, 0.2, seeds=30), runs(rng, 0.8, seeds=3)).value == pytest.approx(0.5, abs=0.03)


def test_a_difference_is_found_where_there_is_one(rng):
    found, p = difference(runs(rng, 0.7), runs(rng, 0.3))
    assert found.low > 0.3
    assert found.high < 0.5
    assert p < 0.01
    none, p = difference(runs(rng, 0.5), runs(rng, 0.5))
    assert none.low < 0 < none.high
    assert p > 0.05


def test_a_mean_difference_weighs_tasks_the_same_and_varies_less_than_one_of_them(rng):
    pairs = [(runs(rng, 0.6), runs(rng, 0.4)) for _ in range(4)]
    alone = [difference(*pair)[0] for pair in pairs]
    together, p = mean_difference(pairs)
    assert together.value == pytest.approx(np.mean([one.value for one in alone]))
    width = np.mean([one.high - one.low for one in alone])
    assert together.high - together.low == pytest.approx(width / 2, rel=0.15)  # four independent tasks
    assert p < 0.05
    assert mean_difference(pairs[:1]) == difference(*pairs[0])


def test_a_mean_difference_varies_with_what_a_seed_does_in_every_task():
    """Two of three seeds always succeed and one never does, in all tasks alike: many tasks are no better known than one."""
    good_and_bad = np.repeat(np.array([1.0, 1.0, 0.0])[:, None, None], 50, axis=2)
    alike = ConditionResults(good_and_bad, list(range(50))), ConditionResults(np.zeros((3, 1, 50)), list(range(50)))
    one, many = (mean_difference([alike] * count)[0] for count in (1, 5))
    assert (many.low, many.high) == pytest.approx((one.low, one.high), abs=0.01)


def test_another_draw_of_resamples_hardly_changes_a_p_value(rng):
    first, second = runs(rng, 0.5), runs(rng, 0.45)
    (_, p), (_, reverse) = difference(first, second), difference(second, first)  # seeds are drawn for the first one first
    assert p == pytest.approx(reverse, abs=0.02)


def test_two_single_runs_are_compared_by_mcnemars_exact_test():
    """Of 50 episodes, the first run alone solves 8, the second alone 1: the p-value is 2 (1 + 9) / 2^9."""
    first, second = np.zeros((2, 1, 1, 50))
    first[..., :20], second[..., 8:21] = 1.0, 1.0
    found, p = difference(*(ConditionResults(side, list(range(50))) for side in (first, second)))
    assert found.value == pytest.approx(0.14)
    assert p == pytest.approx(20 / 512)


def test_single_runs_of_several_checkpoints_are_compared_by_their_means(rng):
    """An episode that half of the checkpoints solve is no outcome that McNemar's test could count."""
    pair = runs(rng, 0.6, seeds=1), runs(rng, 0.4, seeds=1)
    assert difference(*pair) == mean_difference([pair])


def test_few_seeds_have_as_much_spread_as_their_deviation_says():
    """Three seeds without any variation over starts: the resampled means deviate by the standard error, s / sqrt(3)."""
    rates = np.array([0.2, 0.3, 0.7])
    weights = _weights(np.random.default_rng(0), 3)
    assert weights.sum(1) == pytest.approx(1.0)
    assert (weights @ rates).std() == pytest.approx(rates.std(ddof=1) / np.sqrt(3), rel=0.05)


def test_an_interval_ends_where_a_rate_ends():
    """Of three runs two always succeed: the corrected spread of so few would reach beyond 100 %, or below 0 % of failures."""
    success = np.ones((3, 1, 50))
    success[0, 0, :5] = 0.0
    won, lost = (mean_success(ConditionResults(rates, list(range(50)))) for rates in (success, 1 - success))
    assert won.low < won.value < won.high == 1.0
    assert 0.0 == lost.low < lost.value < lost.high


def test_success_at_the_end_is_not_known_of_episodes_that_end_at_success():
    success = np.array([[[1.0, 1.0]]])
    episodes = [made_up(1, True, at_end=False), made_up(2, True)]
    results = ConditionResults(success, [1, 2], episodes=[asdict(episode) for episode in episodes])
    assert results.success_at_end == 0.5
    results.episodes[0]["success_at_end"] = None
    assert results.success_at_end is None


def test_p_values_are_corrected_as_holm_does():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])  # 3 x, 2 x 0.03 twice, 4 x
    assert holm([0.6, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def test_families_of_equal_conditions_rarely_show_a_difference(rng):
    """Of 100 families of ten p-values without any difference, about 5 have one below 5 % after the correction, 40 before."""
    families = rng.uniform(size=(100, 10))
    assert (families.min(1) < 0.05).sum() > 30
    assert sum(min(holm(family)) < 0.05 for family in families) < 12


def test_initial_states_are_compared_one_by_one(rng):
    """Initial states differ far more than conditions do; what is paired still sees a small difference."""
    hard = rng.random(50)
    base = np.tile(hard, (3, 10, 1))
    first, second = (
        ConditionResults((rng.random(base.shape) < base + shift).astype(float), list(range(50))) for shift in (0.06, -0.06)
    )
    found, p = difference(first, second)
    assert found.low > 0
    assert p < 0.01


def test_conditions_of_a_task_are_resampled_with_the_same_initial_states_and_training_seeds_of_their_own(rng):
    """Two conditions that depend on the state alone, or on the seed alone: alike in every resample, or independent."""
    by_start = np.broadcast_to(rng.random(50) < 0.4, (3, 10, 50)).astype(float)
    by_seed = np.broadcast_to(np.array([0.0, 0.0, 1.0])[:, None, None], (3, 10, 50))
    starts, seeds = (ConditionResults(success, list(range(50))) for success in (by_start, by_seed))
    same, again, elsewhere, first, second = resampled_success(
        [("Peg", starts), ("Peg", starts), ("Gear", starts), ("Peg", seeds), ("Peg", seeds)]
    )
    assert np.allclose(same, again)
    for one, other in ((same, elsewhere), (first, second), (same, first)):
        assert abs(np.corrcoef(one, other)[0, 1]) < 0.1


def test_a_difference_says_something_about_training_only_if_both_conditions_have_enough_seeds(rng):
    many, few = runs(rng, 0.5, seeds=3), runs(rng, 0.5, seeds=2)
    assert [has_enough_seeds(*pair) for pair in ((many, many), (many, few), (few, many))] == [True, False, False]


def test_outcomes_that_never_varied_have_an_interval():
    """What did not occur in n episodes may have a rate of up to Wilson's upper limit at no success, z^2 / (n + z^2)."""

    def always(episodes: int, won: int = 1) -> ConditionResults:
        return ConditionResults(np.full((3, 10, episodes), float(won)), list(range(episodes)))

    unseen = 1.96**2 / (50 + 1.96**2)
    assert mean_success(always(50)) == mean_success(always(50), always(50))
    assert (mean_success(always(50)).low, mean_success(always(50)).high) == (pytest.approx(1 - unseen, rel=1e-3), 1.0)
    same, p = difference(always(50, 0), always(50, 0))
    assert (same.value, same.low, same.high) == (0.0, pytest.approx(-unseen, rel=1e-3), pytest.approx(unseen, rel=1e-3))
    assert p == 1.0
    assert mean_success(always(2, 0)).high > 0.6


def test_results_from_before_a_setting_existed_are_of_the_condition_with_its_default():
    def condition(mode: str, config: dict) -> Condition:
        return condition_of(result_of(PEG, dict(obs_mode=mode), config | dict(obs_mode=mode), [made_up(1, True)]))

    now, before, other = (config_of("diffusion_policy", "cpu", "PegInsertion", "rgb+tacrgb", 0) for _ in range(3))
    del before["policy"]["tacrgb_scale"], before["policy"]["encoder"]["tactile_crop"]
    other["policy"]["tacrgb_scale"] = "pixel"
    assert condition("rgb+tacrgb", before) == condition("rgb+tacrgb", now)
    assert condition("rgb+tacrgb", other) != condition("rgb+tacrgb", now)
    assert condition("rgb", other) == condition("rgb", now)  # nothing to scale


def test_episodes_are_matched_by_their_seeds_in_whatever_order_a_file_has_them(tmp_path):
    write(tmp_path, 0, 10, [True, False, False])
    write(tmp_path, 1, 10, [True, False, False])
    path = tmp_path / "1/00000010.json"
    result = json.loads(path.read_text())
    path.write_text(json.dumps(result | dict(episodes=result["episodes"][::-1])))
    (found,) = collect(results_in(tmp_path)).values()
    assert found.success.tolist() == [[[1, 0, 0]], [[1, 0, 0]]]
    assert [episode["seed"] for episode in found.episodes] == 2 * found.episode_seeds
