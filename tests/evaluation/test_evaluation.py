"""Evaluation: its metrics, seeds, limits and intervals, and outcomes that repeat."""

import json
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.utils.wrappers import CPUGymWrapper

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation import evaluate_episode, rollout
from manifeel_ms3.evaluation.agreement import differences
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError
from manifeel_ms3.evaluation.evaluate import Args, evaluation_from_args
from manifeel_ms3.evaluation.gentle import success_under_force
from manifeel_ms3.evaluation.limits import LONGEST_FACTOR, MEAN_FACTOR, STEPS, Limits, limits_of, limits_of_file
from manifeel_ms3.evaluation.policy import EpisodePolicy, PolicyError, PolicySource, load_policy, with_defaults
from manifeel_ms3.evaluation.result import summary_of
from manifeel_ms3.evaluation.rollout import failed_outcome, outcome_as_json, outcome_from_json
from manifeel_ms3.evaluation.statistics import wilson_interval
from manifeel_ms3.experts import make_expert
from manifeel_ms3.tasks.registry import all_tasks
from manifeel_ms3.tasks.registry import make_env as make_from_any_arguments
from tests.evaluation.policies import LetsGo, StandStill
from tests.outcomes import made_up
from tests.sample import states_sample
from tests.tasks_and_marks import PEG


class ExpertPolicy:
    """A demonstrator behind the policy interface, to test the loop around policies."""

    def __init__(self, env, seed, steps=1000, then=(0.0,) * 6):
        self.env, self.seed, self.steps, self.then = env, seed, steps, np.array(then)

    def reset(self):
        self.actions = make_expert(PEG, self.env.unwrapped, self.seed).actions()
        self.said = []

    def act(self, obs):
        self.said.append(next(self.actions) if len(self.said) < self.steps else self.then)
        return self.said[-1]


LIMIT = 120
BARE = dict(obs_mode="none", render_backend="none", fit="paper", max_episode_steps=LIMIT)
UP = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def pulled_out(make_env):
    """An episode whose peg is pulled out after the success, and the actions."""
    env = make_env(**BARE)
    policy = ExpertPolicy(env, 1, steps=70, then=UP)
    return evaluate_episode(env, policy, seed=1), policy.said


def test_an_episode_runs_to_the_time_limit_and_its_end_is_not_its_success(pulled_out):
    outcome, _ = pulled_out
    assert outcome.success_once
    assert not outcome.success_at_end
    assert (outcome.fail_once, outcome.fail_at_end) == (False, False)
    assert outcome.episode_len == LIMIT
    assert 20 < outcome.first_success < LIMIT
    assert 5 < outcome.force_until_success <= outcome.peak_contact_force < 60
    assert outcome.success_paper  # a plug in its socket meets the paper's threshold, too


def test_the_metrics_are_those_of_maniskill(make_env, pulled_out):
    outcome, actions = pulled_out
    env = CPUGymWrapper(make_env(**BARE), ignore_terminations=True, record_metrics=True)
    env.reset(seed=1)
    infos = [env.step(action)[-1] for action in actions]
    theirs = infos[-1]["episode"]
    ours = outcome_as_json(outcome)
    for name in ("success_once", "success_at_end", "fail_once", "fail_at_end", "episode_len"):
        assert ours[name] == theirs[name]
    for name in ("return", "reward"):
        assert ours[name] == pytest.approx(float(theirs[name]), rel=1e-5)
    assert outcome.first_success == 1 + [bool(info["success"]) for info in infos].index(True)
    forces = [float(info["contact_force"]) for info in infos]
    assert outcome.force_until_success == pytest.approx(max(forces[: outcome.first_success]), abs=1e-3)


def test_an_episode_that_stops_at_success_does_not_know_its_end(make_env, pulled_out):
    env = make_env(**BARE)
    stopped = evaluate_episode(env, ExpertPolicy(env, 1), seed=1, stop_at_success=True)
    assert stopped.episode_len == stopped.first_success == pulled_out[0].first_success
    assert stopped.force_until_success == pulled_out[0].force_until_success
    entries = outcome_as_json(stopped)
    assert not {"success_at_end", "fail_at_end", "success_paper"} & set(entries)
    assert outcome_from_json(entries) == stopped
    summary = summary_of([entries], force_limit=1.0)
    assert summary["stop_at_success"]
    assert not {"success_at_end", "fail_at_end"} & set(summary)
    assert (summary["success_once"]["rate"], summary["gentle_success"]["rate"]) == (1.0, 0.0)


def test_a_policy_that_stands_still_never_succeeds(make_env):
    lost = evaluate_episode(make_env(**BARE), StandStill(), seed=1)
    assert (lost.success_once, lost.success_at_end, lost.first_success, lost.force_until_success) == (False, False, None, None)
    assert lost.episode_len == LIMIT
    assert lost.ending == "beside or above the hole"
    assert lost.success_paper is False


def test_the_papers_threshold_may_be_met_without_success_and_counts_at_any_step(make_env):
    """The peg is pulled out before it has been in place for half a second."""
    env = make_env(**BARE | dict(max_episode_steps=70))
    outcome = evaluate_episode(env, ExpertPolicy(env, 1, steps=44, then=UP), seed=1)
    assert (outcome.success_once, outcome.success_paper, outcome.ending) == (False, True, "beside or above the hole")


def test_a_policy_that_drops_the_peg_has_lost(make_env):
    env = make_env(**BARE | dict(max_episode_steps=20), control_mode="pd_ee_delta_pose")
    lost, stopped = (evaluate_episode(env, LetsGo(), 1, stop_at_success=stops) for stops in (False, True))
    assert (lost.success_once, lost.fail_once, lost.fail_at_end, lost.episode_len, lost.ending) == (
        False,
        True,
        True,
        20,
        "lost",
    )
    assert (stopped.fail_once, stopped.fail_at_end, stopped.ending) == (True, None, "lost")
    assert 0 < stopped.episode_len < 20


def test_an_episode_without_an_outcome_is_no_success_by_the_papers_threshold():
    reached = replace(made_up(1, True), success_paper=True)
    episodes = list(map(outcome_as_json, (reached, failed_outcome(2, "the process crashed", stop_at_success=False))))
    assert summary_of(episodes, None)["success_paper"]["rate"] == 0.5
    assert "success_paper" not in summary_of(episodes[1:], None)  # as of a task without a threshold
    older = outcome_as_json(made_up(3, True))  # of before it was measured
    assert "success_paper" not in summary_of([*episodes, older], None)


def test_an_episode_is_said_to_have_succeeded_whatever_came_after(pulled_out):
    assert pulled_out[0].ending == "success"


@pytest.mark.parametrize("spec", all_tasks().values(), ids=lambda spec: spec.name)
def test_every_task_says_what_a_policy_that_stands_still_lacks(spec):
    with closing(gym.make(spec.env_id, obs_mode="none", render_backend="none")) as env:
        env.reset(seed=0)
        *_, info = env.step(np.zeros(env.action_space.shape, np.float32))
        missing = env.unwrapped.shortcomings(info)
    assert missing
    assert all(holds.shape == (1,) and holds.dtype == torch.bool for holds in missing.values())
    assert sum(bool(holds) for holds in missing.values()) >= 1  # else an episode would end in a mere time-out


BESIDE, HIGH, ASKEW = (
    "beside or above the hole",
    "in the hole, not pressed home",
    "pressed home, not upright or not for long enough",
)


@pytest.mark.parametrize(
    ("task", "endings"),
    [
        ("PegInsertion", {BESIDE: dict(gap=0.03), HIGH: dict(gap=0.005), ASKEW: dict(tilt=0.3)}),
        ("GearAssembly", {"a neighbouring gear pushed off its shaft": dict(neighbours_off=0.1)}),
        ("PegReorientation", {"peg not turned in the hand": dict(in_hand=0.3, gap=0.03), BESIDE: dict(gap=0.03)}),
        ("ObjectSearch", {"battery not gripped": dict(height=0.01), "battery gripped, not lifted": dict(height=0.05)}),
        (
            "BallSorting",
            {
                "wrong ball taken": dict(tennis_away=0.05, golf_height=0.05),
                "golf ball taken, not lifted": dict(golf_height=0.05),
                "no ball taken": {},
            },
        ),
        (
            "NutBoltAssembly",
            {
                "beside the axis": dict(descent=1e-3, offset=0.01),
                "threads not engaged": dict(descent=-1e-3),
                "engaged, not tight": dict(descent=1e-3),
            },
        ),
    ],
)
def test_an_episode_that_fails_is_said_to_lack_what_it_lacks(make_env, task, endings):
    env = make_env(f"ManiFeel-{task}-v1", obs_mode="none", render_backend="none")
    env.reset(seed=0)
    nothing = {name: torch.zeros_like(values) for name, values in env.unwrapped.measure().items()}
    for lacks, changed in endings.items():
        measures = nothing | {name: torch.full_like(nothing[name], value) for name, value in changed.items()}
        missing = env.unwrapped.shortcomings(measures)
        assert next(name for name, holds in missing.items() if holds) == lacks


class Scripted:
    """An environment whose steps have known forces (N), rewards, successes and failures; the last step is the time limit."""

    single_action_space = gym.spaces.Box(-1.0, 1.0, (6,))

    def __init__(self, *steps: tuple[float, float, bool, bool]):
        self.unwrapped, self.steps = self, steps

    def reset(self, seed):
        self.left = list(self.steps)
        return {}, {}

    def step(self, action):
        force, reward, success, fail = self.left.pop(0)
        info = dict(contact_force=torch.tensor([force]), success=success, fail=fail, success_paper=success)
        return {}, reward, success or fail, not self.left, info


@pytest.mark.parametrize("broken", [(np.nan, 1.0), (np.inf, 1.0), (1.0, np.nan), (1.0, -np.inf)], ids=str)
def test_an_episode_whose_simulation_diverges_has_failed_whatever_it_reached_before(broken):
    outcome = evaluate_episode(
        Scripted((7.0, 0.5, True, False), (*broken, True, False), (1.0, 1.0, True, False)), StandStill(), 1
    )
    assert outcome.error.startswith("step 2: the simulation has diverged")
    assert (outcome.success_once, outcome.success_at_end, outcome.success_paper) == (False, False, False)
    assert (outcome.first_success, outcome.force_until_success, outcome.ending) == (None, None, "error")
    assert (outcome.return_, outcome.peak_contact_force) == (0.5, 7.0)


def test_a_failure_is_remembered_and_the_end_is_that_of_the_last_step():
    steps = (3.0, 0.1, False, True), (9.0, 0.2, False, False), (5.0, 0.3, False, False)
    outcome = evaluate_episode(Scripted(*steps), StandStill(), 1)
    assert (outcome.fail_once, outcome.fail_at_end, outcome.ending) == (True, False, "lost")
    assert (outcome.episode_len, outcome.return_, outcome.reward) == (3, 0.6, 0.2)
    won, hard = (1.0, 1.0, True, False), (9.0, 1.0, False, False)
    outcome = evaluate_episode(Scripted((8.0, 0.0, False, False), won, hard, won), StandStill(), 1)
    assert (outcome.first_success, outcome.force_until_success, outcome.peak_contact_force) == (2, 8.0, 9.0)


def test_the_time_of_a_policy_is_in_milliseconds_and_without_its_waiting(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(rollout.time, "perf_counter", lambda: clock[0])

    class Thinks(StandStill):
        waited = 0.02

        def act(self, obs):
            clock[0] += 0.05
            return super().act(obs)

    assert evaluate_episode(Scripted(*[(1.0, 0.0, False, False)] * 4), Thinks(), 1).inference_ms == 30.0


def test_a_checkpoint_acts_again_with_the_device_the_batches_and_the_steps_of_its_result():
    result = dict(config=dict(inference_steps=8, lr=0.1), inference=dict(device="cpu", batch_size=3))
    for given, steps in (({}, 8), (dict(inference_steps=2), 2)):
        source = PolicySource(Path("checkpoint"), kwargs=json.dumps(given), batch_size=1).as_in(result)
        assert (source.device, source.batch_size, json.loads(source.kwargs)) == ("cpu", 3, dict(inference_steps=steps))


def test_same_policy_and_seed_give_the_same_outcome(make_env):
    env = make_env(**BARE)
    first = evaluate_episode(env, ExpertPolicy(env, 2), seed=2)
    evaluate_episode(env, ExpertPolicy(env, 3), seed=3)
    again = evaluate_episode(env, ExpertPolicy(env, 2), seed=2)
    assert first.error is None
    assert replace(first, inference_ms=0.0) == replace(again, inference_ms=0.0)


def test_the_success_under_a_force_counts_the_force_until_the_first_success():
    episodes = [
        outcome_as_json(made_up(seed, won, force=force)) for seed, won, force in ((1, True, 5), (2, True, 9), (3, False, 1))
    ]
    episodes[0]["peak_contact_force"] = 50.0  # after the success
    assert success_under_force(episodes, [0, 5, 8.9, 9, 100]).tolist() == [0, 1 / 3, 1 / 3, 2 / 3, 2 / 3]
    summary = summary_of(episodes, force_limit=6.0)
    assert summary["force_limit"] == 6.0
    assert summary["gentle_success"]["rate"] == 1 / 3
    assert "gentle_success" not in summary_of(episodes, None)


def test_a_result_holds_the_rates_and_means_of_all_its_episodes():
    episodes = [outcome_as_json(made_up(seed, seed < 3, length=10 * seed)) for seed in (1, 2, 3, 6)]
    episodes[0]["success_at_end"], episodes[2]["fail_once"], episodes[3]["fail_once"] = False, True, True
    episodes[3]["fail_at_end"] = True
    summary = summary_of(episodes, None)
    rates = {name: summary[name]["rate"] for name in ("success_once", "success_at_end", "fail_once", "fail_at_end")}
    assert rates == dict(success_once=0.5, success_at_end=0.25, fail_once=0.5, fail_at_end=0.25)
    assert (summary["episode_len"], summary["return"], summary["reward"]) == (30.0, 15.0, 0.5)
    low, high = wilson_interval(1, 4)
    assert (summary["fail_at_end"]["low"], summary["fail_at_end"]["high"]) == pytest.approx((low, high), abs=1e-4)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (dict(success_once=False), ["success_once"]),
        (dict(success_at_end=False), ["success_at_end"]),
        (dict(fail_once=True), ["fail_once"]),
        (dict(fail_at_end=True), ["fail_at_end"]),
        (dict(first_success=2), ["first_success"]),
        (dict(first_success=None), ["first_success"]),
        (dict(success_paper=False), ["success_paper"]),
        (dict(episode_len=10), ["episode_len"]),
        (dict(peak_contact_force=1.02), ["peak_contact_force"]),
        (dict(force_until_success=0.98), ["force_until_success"]),
        (dict(force_until_success=None), ["force_until_success"]),
        (dict(peak_contact_force=1.009, force_until_success=0.991, inference_ms=9.0, return_=4.6), []),
    ],
    ids=str,
)
def test_an_episode_that_is_run_again_has_the_same_outcome_or_is_said_to_differ(change, named):
    outcome = replace(made_up(1, True), success_paper=True)
    assert [said.split()[0] for said in differences(outcome_as_json(outcome), replace(outcome, **change))] == named


LONGEST = dict(
    PegInsertion=157, USBInsertion=157, PowerPlugInsertion=157, GearAssembly=391, NutBoltAssembly=502, BulbInstallation=491
)
"""Control steps of the longest demonstration that was recorded where those of the sample are shorter; the plugs share the limit
of the tight USB plug."""


@pytest.mark.parametrize("spec", all_tasks().values(), ids=lambda spec: spec.name)
def test_limits_follow_from_demonstrations(spec):
    sample = limits_of_file(states_sample(spec.env_id))
    longest = max(sample.longest, LONGEST.get(spec.name, 0))
    assert spec.max_episode_steps >= LONGEST_FACTOR * longest
    assert spec.max_episode_steps >= MEAN_FACTOR * spec.demo_steps - STEPS
    assert spec.max_episode_steps <= max(1.5 * MEAN_FACTOR * spec.demo_steps, LONGEST_FACTOR * longest + STEPS)
    assert spec.force_limit == pytest.approx(sample.force_limit, rel=0.35)  # of two demonstrations


def test_limits_are_twice_the_mean_or_more_where_one_demonstration_is_long():
    assert limits_of([80, 90, 100], [10.0, 30.0, 12.0]) == Limits(180, 24.0, 90.0, 100)
    assert limits_of([50, 50, 101], [10.0]).max_episode_steps == 160


def test_wilson_interval_matches_published_values():
    # Newcombe 1998, table I, method 3: 81/263 and 0/20
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


@pytest.mark.parametrize(
    ("config", "word"),
    [
        (None, "no config.json"),
        ("{", "not json"),
        ("[]", "holds a list instead of an object"),
        ('{"policy_name": "juggler"}', "'juggler' is not registered .*diffusion_policy.*install the package"),
        (
            '{"kind": "baselines.common.agent:PolicyAgent", "policy_class": "nowhere:Policy"}',  # as older versions wrote it
            "no policy_name.*train the policy again",
        ),
    ],
)
def test_broken_checkpoints_say_what_is_wrong(tmp_path, config, word):
    if config is not None:
        (tmp_path / "config.json").write_text(config)
    with pytest.raises(CheckpointError, match=word) as error:
        load_policy(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("entries", "wrong"),
    [
        (dict(env_kwargs=None), "env_kwargs"),
        (dict(env_id=["x"]), "env_id"),
        (dict(cameras="wrist", tactile_sensors=3), "cameras', 'tactile_sensors"),
        (dict(obs_mode=None), "obs_mode"),
    ],
)
def test_the_config_of_a_checkpoint_that_a_stranger_changed_is_refused(tmp_path, entries, wrong):
    config = dict(env_id=PEG, env_kwargs={}, obs_mode="rgb", cameras=["wrist"], tactile_sensors=["right"]) | entries
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=rf"\['{wrong}'\] in its config.json have another form"):
        evaluation_from_args(Args(tmp_path))


def test_an_argument_that_the_policy_of_a_checkpoint_does_not_take_is_named():
    checkpoint = Path("leaderboard/cpu/PegInsertion/rgb/seed0/checkpoints/00007000")
    with pytest.raises(PolicyError, match=r"cannot be made with --policy-kwargs \{\"foo\": 1\} .*'foo'"):
        PolicySource(checkpoint, kwargs='{"foo": 1}', device="cpu", batch_size=1).make()


def test_the_result_of_a_checkpoint_holds_the_arguments_of_its_policy():
    checkpoint = Path("leaderboard/cpu/PegInsertion/rgb/seed0/checkpoints/00007000")
    assert "policy_kwargs" not in evaluation_from_args(Args(checkpoint)).config
    evaluation = evaluation_from_args(Args(checkpoint, policy_kwargs='{"seed": 5}'))
    assert evaluation.config["policy_kwargs"] == {"seed": 5}
    again = PolicySource(checkpoint).as_in(dict(config=evaluation.config, inference=dict(device="cpu", batch_size=1)))
    assert json.loads(again.kwargs)["seed"] == 5


def test_a_time_limit_below_one_step_is_refused():
    with pytest.raises(InvalidArgumentError, match="max_episode_steps=-1 must be at least 1"):  # ManiSkill ends at once
        make_from_any_arguments(PEG, obs_mode="none", render_backend="none", max_episode_steps=-1)


def test_a_policy_is_found_in_the_working_folder(tmp_path, monkeypatch):
    """An installed command, unlike `python -m`, does not look there by itself."""
    (tmp_path / "a_policy_of_mine.py").write_text("class Mine:\n    def __init__(self, gain): self.gain = gain\n")
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    monkeypatch.chdir(tmp_path)
    source = PolicySource(policy="a_policy_of_mine:Mine", kwargs='{"gain": 2}')
    assert source.fingerprint() is not None
    assert source.make().gain == 2
    assert sys.path[-1] == str(tmp_path)  # last, so that nothing here takes the place of an installed module


class Blind(StandStill):
    """A policy with some of the optional members, that derives from nothing of this package."""

    looks, waited = False, 0.5

    def begin_episode(self, seed):
        self.seed = seed


class Derived(EpisodePolicy):
    def reset(self):
        self.episodes = getattr(self, "episodes", 0) + 1

    def act(self, obs):
        return np.zeros(6)


class Confused(StandStill):
    """A policy that cannot say whether it looks."""

    @property
    def looks(self):
        return 1 / 0


def test_members_of_a_policy_that_fail_are_its_fault_and_end_only_its_episode(make_env):
    env = make_env(**BARE)
    impatient = StandStill()
    impatient.waited = None
    for policy, reason in ((Confused(), "step 0: ZeroDivisionError"), (impatient, "step 0: TypeError")):
        assert reason in evaluate_episode(env, policy, 100000).error


def test_a_policy_with_the_two_methods_has_the_defaults_of_all_others():
    plain, blind, derived = StandStill(), Blind(), Derived()
    assert with_defaults(derived) is derived
    for policy in (with_defaults(plain), derived):
        policy.begin_episode(3)
        assert (policy.looks, policy.waited, policy.limits_itself) == (True, 0.0, False)
    assert (plain.steps, derived.episodes) == (0, 1)
    assert with_defaults(plain).act({}).shape == (6,)
    with_defaults(blind).begin_episode(3)
    assert blind.seed == 3
    assert (with_defaults(blind).looks, with_defaults(blind).waited, with_defaults(blind).limits_itself) == (False, 0.5, False)
