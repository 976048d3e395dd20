"""The policy's process: one policy answers all episodes, whatever the others do and whoever simulates them."""

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from imageio.v3 import imread
from mani_skill.utils.wrappers import CPUGymWrapper

from baselines.diffusion_policy.train import SPEC
from baselines.registry import policy_spec
from manifeel_ms3.errors import InvalidArgumentError, MachineError, WorkFailedError
from manifeel_ms3.evaluation import policy_process
from manifeel_ms3.evaluation.engine import Evaluation, run_episodes
from manifeel_ms3.evaluation.evaluate import Args, evaluation_from_args
from manifeel_ms3.evaluation.policy import PolicyError, PolicyRequest, PolicySource, PolicyUnavailableError
from manifeel_ms3.evaluation.policy_process import PolicyProcess, SharedPolicy
from manifeel_ms3.evaluation.rollout import PolicyFault, evaluate_episode
from manifeel_ms3.evaluation.vector import make_eval_envs
from manifeel_ms3.wrappers import FlattenVisuotactileObservationWrapper
from tests.evaluation.batch_policies import (
    CRASHES,
    FINE,
    HANGS,
    KILLED,
    MISCOUNTS,
    RAISES,
    CannotBeMade,
    CrashesOnce,
    DiesWhenMade,
    KillsASimulation,
    Moody,
    Single,
    source_of,
)
from tests.tasks_and_marks import PEG, needs_renderer
from tests.trust.running_evaluations import alive, wait_for_episodes
from tests.trust.tiny_checkpoint import save_tiny_checkpoint

BARE = dict(obs_mode="tacff", render_backend="none", max_episode_steps=6, sim_backend="physx_cpu")


def nothing():
    raise AssertionError("the policy is shared")


# ------------------------------------------------------------------------------- the process


@pytest.fixture(scope="module")
def process():
    with PolicyProcess(source_of(Moody), answer_timeout=2.0) as process:
        assert answer_to(process, FINE) == [FINE, 0, 1]  # the first answer may take longer than the limit
        yield process


def answer_to(process, seed):
    policy = SharedPolicy(process.address, nothing)
    policy.begin_episode(seed)
    try:
        return policy.act({}).tolist()
    except PolicyFault as fault:
        return str(fault)


def answers_to(process, *seeds):
    """The answers to requests that are sent at the same time."""
    with ThreadPoolExecutor(len(seeds)) as threads:
        return list(threads.map(lambda seed: answer_to(process, seed), seeds))


def test_requests_of_all_episodes_are_answered_in_batches_each_with_its_own_answer(process):
    answers = answers_to(process, *range(FINE, FINE + 8))
    assert [answer[:2] for answer in answers] == [[seed, 0] for seed in range(FINE, FINE + 8)]
    assert max(answer[2] for answer in answers) > 1
    assert max(answer[2] for answer in answers) <= Moody.batch_size


def test_the_time_that_a_request_waits_for_others_is_told_apart_from_that_of_its_answer(process):
    """An answer takes 0.2 s, during which the requests that come later wait."""

    def ask(seed: int) -> tuple[float, float]:
        policy = SharedPolicy(process.address, nothing)
        policy.begin_episode(seed)
        begin = time.monotonic()
        policy.act({})
        return policy.waited, time.monotonic() - begin

    with ThreadPoolExecutor(6) as threads:
        times = list(threads.map(ask, range(FINE, FINE + 6)))
    assert max(waited for waited, _ in times) > 0.1
    assert all(took - waited > 0.19 for waited, took in times)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (RAISES, "RuntimeError: out of ideas"),
        (MISCOUNTS, "0 answers to 1 requests"),
        (CRASHES, "exit code 7"),
        (HANGS, "no answer within 2 s"),
    ],
)
def test_an_episode_that_ends_the_policy_fails_alone(process, bad, reason, monkeypatch):
    # a request that hangs may be the first that a new process is asked, and this policy has no libraries to initialize
    monkeypatch.setattr(policy_process, "FIRST_ANSWER", 5.0)
    answers = answers_to(process, FINE, FINE + 1, bad, FINE + 2)
    assert [answer[:2] for answer in answers[:2] + answers[3:]] == [[FINE, 0], [FINE + 1, 0], [FINE + 2, 0]]
    assert reason in answers[2]
    assert answer_to(process, FINE) == [FINE, 0, 1]


@pytest.mark.parametrize(
    ("policy", "kind", "reason"),
    [(CannotBeMade, PolicyError, "OSError: no weights"), (DiesWhenMade, WorkFailedError, "exit code 9.*before the policy")],
)
def test_a_policy_that_cannot_be_made_ends_the_evaluation_with_the_reason(policy, kind, reason):
    with pytest.raises(kind, match=reason):
        run_episodes(Evaluation(source_of(policy), PEG, BARE, {}), [1], workers=1)


def test_a_policy_that_cannot_be_loaded_again_ends_the_evaluation_and_fails_no_episode(tmp_path, monkeypatch):
    monkeypatch.setenv("CRASHES_ONCE", str(tmp_path / "marker"))
    with PolicyProcess(source_of(CrashesOnce), answer_timeout=20.0) as process:
        part = SharedPolicy(process.address, nothing)
        part.begin_episode(FINE)
        assert part.act({}).tolist() == [FINE, 0, 1]
        assert "exit code 7" in answer_to(process, CRASHES)  # a fault of the policy
        with pytest.raises(PolicyUnavailableError, match=r"could not be loaded again .*out of memory.*; run the command again"):
            part.act({})


def test_a_policy_that_answers_one_episode_is_made_where_it_is_asked():
    with PolicyProcess(source_of(Single), 2.0) as process:
        policies = [SharedPolicy(process.address, Single) for _ in range(2)]
        assert [policy.act({}).tolist() for policy in policies] == [[0.0] * 6] * 2
        assert not policies[0].limits_itself


def test_whoever_asks_a_process_that_has_ended_is_told():
    with PolicyProcess(source_of(Moody), 2.0) as process:
        policy = SharedPolicy(process.address, nothing)
        policy.begin_episode(FINE)
    with pytest.raises(PolicyUnavailableError, match="has ended; run the command again"):
        policy.act({})


# ------------------------------------------------------------------------------- what a policy answers


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return save_tiny_checkpoint(tmp_path_factory.mktemp("checkpoint") / "00000001")


def requests(count: int, pose_features: int = 7) -> list[PolicyRequest]:
    chance = np.random.default_rng(0)
    return [
        PolicyRequest(
            100_000 + k,
            2 * k,
            {
                "sensor_data/tactile_right/force_field": chance.random((2, 10, 14, 3), np.float32),
                "extra/tcp_pose": chance.random((2, pose_features), np.float32),
            },
        )
        for k in range(count)
    ]


@pytest.mark.parametrize(
    ("policy", "steps", "batch_size"),
    [
        ("diffusion_policy", 20, 1),  # DDPM, which draws noise at every step
        ("diffusion_policy", 20, 4),
        ("diffusion_policy", 4, 1),  # DDIM
        ("diffusion_policy", 4, 4),
        ("equivariant_diffusion_policy", 4, 4),
        ("flow_matching", 4, 4),
    ],
)
def test_an_answer_does_not_depend_on_the_other_requests_of_its_batch(tmp_path, policy, steps, batch_size):
    checkpoint = save_tiny_checkpoint(tmp_path / "1", policy=policy)
    agent = policy_spec(policy).load(checkpoint, batch_size=batch_size, inference_steps=steps)
    asked = requests(6, agent.policy.spec.pose_features)
    together = agent.answer(asked)
    assert len({answer.tobytes() for answer in together}) == 6
    for order in ([5, 3, 1], [2], [4, 0], [0, 4, 2, 1, 3, 5]):
        for index, answer in zip(order, agent.answer([asked[index] for index in order]), strict=True):
            np.testing.assert_array_equal(answer, together[index])


def test_batch_sizes_differ_by_rounding_alone(checkpoint):
    asked = requests(6)
    answers = [np.stack(SPEC.load(checkpoint, batch_size=size).answer(asked)) for size in (1, 3, 4)]
    for other in answers[1:]:
        np.testing.assert_allclose(other, answers[0], atol=5e-5)  # of actions in [-1, 1], after 20 steps of inference


def test_noise_depends_on_the_seed_of_the_episode_and_on_the_step(checkpoint):
    agent, (first, *_) = SPEC.load(checkpoint), requests(1)
    answers = agent.answer([first, replace(first, seed=7), replace(first, step=7), first])
    assert len({answer.tobytes() for answer in answers}) == 3
    np.testing.assert_array_equal(answers[0], answers[3])


def test_an_answer_has_no_other_chance_than_its_noise(tmp_path):
    """Such as the random crops of training."""
    agent = SPEC.load(save_tiny_checkpoint(tmp_path / "1", "rgb", ("wrist",), crop=24))
    (request,) = requests(1)
    images = np.random.default_rng(0).integers(0, 256, (2, 32, 32, 3), np.uint8)
    seen = {"sensor_data/wrist/rgb": images, "extra/tcp_pose": request.observation["extra/tcp_pose"]}
    first, *others = (agent.answer([replace(request, observation=seen)])[0] for _ in range(3))
    assert all(np.array_equal(first, other) for other in others)


def outcomes_with(checkpoint, workers):
    source = PolicySource(checkpoint, device="cpu", batch_size=2)
    outcomes = run_episodes(Evaluation(source, PEG, BARE, {}), [100_000, 100_001, 100_005], workers)
    return [replace(outcome, inference_ms=0.0) for outcome in outcomes]


@pytest.fixture(scope="module")
def outcomes_with_one_worker(checkpoint):
    return outcomes_with(checkpoint, 1)


@pytest.mark.parametrize("workers", [3, pytest.param(2, marks=pytest.mark.slow)])
def test_the_number_of_workers_changes_no_outcome(checkpoint, outcomes_with_one_worker, workers):
    expected = outcomes_with_one_worker
    assert outcomes_with(checkpoint, workers) == expected
    assert all(outcome.error is None and outcome.episode_len == 6 for outcome in expected)
    assert len({outcome.return_ for outcome in expected}) == 3


def test_a_simulating_process_that_is_killed_fails_its_episode_alone(checkpoint, outcomes_with_one_worker):
    """Two processes simulate, so that one of the first two episodes has finished when the third begins."""
    source, told = replace(source_of(KillsASimulation), kwargs=json.dumps(dict(checkpoint=str(checkpoint)))), []
    outcomes = run_episodes(Evaluation(source, PEG, BARE, {}), [100_000, 100_001, KILLED, 100_005], 2, told.append)
    killed = outcomes.pop(2)
    assert killed.error == "the simulating process ended with exit code -9: it crashed, or hung for good"
    assert not killed.success_once
    assert [replace(outcome, inference_ms=0.0) for outcome in outcomes] == outcomes_with_one_worker
    assert told[0].error is None
    assert len(told) == 4


class Watched:
    """A policy that records the actions of another; it looks at every step, or only when the other does."""

    def __init__(self, agent, always):
        self.agent, self.always, self.actions, self.seen = agent, always, [], []

    @property
    def looks(self):
        return self.always or self.agent.looks

    def reset(self):
        self.agent.begin_episode(5)

    def act(self, obs):
        self.seen.append("wrist" in obs["sensor_data"])
        self.actions.append(self.agent.act(obs))
        return self.actions[-1]


@needs_renderer
def test_images_that_the_policy_does_not_look_at_are_not_rendered_and_change_nothing(tmp_path, make_env):
    agent = SPEC.load(save_tiny_checkpoint(tmp_path / "1", obs_mode="rgb+tacff", cameras=("wrist",)))
    env = make_env(obs_mode="rgb+tacff", cameras=("wrist",), max_episode_steps=18)
    always, sometimes = Watched(agent, True), Watched(agent, False)
    for policy in (always, sometimes):
        assert evaluate_episode(env, policy, seed=5).error is None
    np.testing.assert_array_equal(always.actions, sometimes.actions)
    assert always.seen == [True] * 18
    # predictions are made at steps 0, 8 and 16 from two observations each
    assert [step for step, saw in enumerate(sometimes.seen) if saw] == [0, 7, 8, 15, 16]
    assert "wrist" in env.unwrapped.get_obs()["sensor_data"]


# ------------------------------------------------------------------------------- what is evaluated


def config_with(checkpoint, tmp_path, **changes):
    folder = tmp_path / "checkpoint"
    folder.mkdir()
    shutil.copy(checkpoint / "model.safetensors", folder)
    config = json.loads((checkpoint / "config.json").read_text()) | dict(env_id=PEG) | changes
    (folder / "config.json").write_text(json.dumps(config))
    return folder


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_device_that_is_not_there_is_named_before_anything_starts(checkpoint, tmp_path):
    folder = config_with(checkpoint, tmp_path)
    assert evaluation_from_args(Args(folder)).source.device == "cpu"
    with pytest.raises(MachineError, match=r"--device cuda is not there .*give --device cpu"):
        evaluation_from_args(Args(folder, device="cuda"))
    with pytest.raises(ValueError, match="'toaster' is no device"):
        evaluation_from_args(Args(folder, device="toaster"))
    with pytest.raises(ValueError, match="--batch-size 0 is less than 1"):
        evaluation_from_args(Args(folder, batch_size=0))
    with pytest.raises(ValueError, match="only a --checkpoint takes --device"):
        evaluation_from_args(Args(policy="a:B", env_id=PEG, obs_mode="tacff", device="cpu"))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (dict(env_id="USBInsertion"), "--env-id ManiFeel-USBInsertion-v1: .* was trained with ManiFeel-PegInsertion-v1; leave"),
        (dict(obs_mode="rgb+tacff"), "--obs-mode rgb.tacff: .* was trained with tacff; leave it out"),
        (dict(cameras=("side",)), r"--cameras \['side'\]: .* was trained with \['wrist'\]; leave it out"),
        (dict(tactile_sensors=("left",)), r"--tactile-sensors \['left'\]: .* was trained with \['right'\]; leave it out"),
    ],
)
def test_what_a_checkpoint_brings_cannot_be_asked_for_in_another_form(checkpoint, tmp_path, given, said):
    folder = config_with(checkpoint, tmp_path, obs_mode="tacff", cameras=["wrist"])
    same = evaluation_from_args(Args(folder, env_id="PegInsertion", obs_mode="tacff", cameras=("wrist",)))
    assert same == evaluation_from_args(Args(folder))
    with pytest.raises(InvalidArgumentError, match=said):
        evaluation_from_args(Args(folder, **given))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (dict(step_timeout=0.0), "--step-timeout 0.0 must be"),
        (dict(step_timeout=-1.0), "--step-timeout -1.0 must be"),
        (dict(step_timeout=float("nan")), "--step-timeout nan must be"),
        (dict(inference_steps=0), "--inference-steps 0 must be at least 1"),
        (dict(workers=0), "--num-eval-envs 0 must be at least 1"),
    ],
)
def test_numbers_with_which_no_episode_could_succeed_are_refused(given, said):
    with pytest.raises(InvalidArgumentError, match=said):
        evaluation_from_args(Args(policy="a:B", env_id=PEG, obs_mode="tacff", **given))


def test_a_policy_is_evaluated_on_the_task_of_its_demonstrations_unless_told_otherwise(checkpoint, tmp_path, caplog):
    trained = dict(fit="tight", lighting="dim", max_episode_steps=999, hold_seconds=2.0)
    folder = config_with(checkpoint, tmp_path, env_kwargs=trained)
    with caplog.at_level(logging.WARNING):
        evaluation = evaluation_from_args(Args(folder))
        assert (evaluation.env_kwargs["fit"], evaluation.env_kwargs["lighting"]) == ("tight", "dim")
        assert not {"max_episode_steps", "hold_seconds"} & set(evaluation.env_kwargs)
        assert not evaluation.stop_at_success
        assert evaluation_from_args(Args(folder, stop_at_success=True)).stop_at_success
        own_limit = (
            "the demonstrations of the policy had max_episode_steps 999; the evaluation has the task's own limit, "
            "unless --env-kwargs gives another"
        )
        assert set(caplog.messages) == {own_limit}
        caplog.clear()
        evaluation = evaluation_from_args(
            Args(folder, env_kwargs='{"fit": "paper", "lighting": "dim", "max_episode_steps": 500}')
        )
    assert (evaluation.env_kwargs["fit"], evaluation.env_kwargs["max_episode_steps"]) == ("paper", 500)
    assert caplog.messages == [
        "--env-kwargs: fit is 'paper' here, but 'tight' in the demonstrations of the policy",
        "--env-kwargs: max_episode_steps is 500 here, but 999 in the demonstrations of the policy",
    ]


def test_an_argument_that_the_demonstrations_left_at_its_default_is_compared_with_it(checkpoint, tmp_path, caplog):
    folder = config_with(checkpoint, tmp_path, env_kwargs={})
    with caplog.at_level(logging.WARNING):
        evaluation_from_args(Args(folder, env_kwargs='{"fit": "paper", "render_backend": "none", "max_episode_steps": 9}'))
        assert not caplog.messages
        evaluation_from_args(Args(folder, env_kwargs='{"fit": "tight"}'))
    assert caplog.messages == ["--env-kwargs: fit is 'tight' here, but 'paper' in the demonstrations of the policy"]


@pytest.mark.slow
def test_ctrl_c_ends_an_evaluation_and_the_policys_process_at_once(checkpoint, tmp_path, figure):
    out, journal = tmp_path / "evaluation.json", tmp_path / "evaluation.episodes.jsonl"
    kwargs = json.dumps(dict(render_backend="none", max_episode_steps=8))
    command = [sys.executable, "-m", "manifeel_ms3.evaluation.evaluate", "--episodes", "40", "--env-kwargs", kwargs]
    command += ["--checkpoint", str(config_with(checkpoint, tmp_path)), "--out", str(out)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    wait_for_episodes(journal, 1)
    begin = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    figure("seconds from Ctrl-C to the end of an evaluation with a policy's process", time.monotonic() - begin, at_most=2.0)
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert "episodes are finished and kept in" in errors
    while alive(process.pid):
        assert time.monotonic() < begin + 60, "a process is left"
        time.sleep(0.1)


# ------------------------------------------------------------------------------- vectorised environments


@pytest.mark.parametrize("num_envs", [1, 2])
def test_evaluation_environments_are_made_as_in_maniskills_baselines(num_envs):
    kwargs = dict(obs_mode="state", render_backend="none", max_episode_steps=2)
    envs = make_eval_envs(PEG, num_envs, env_kwargs=kwargs, other_kwargs=dict(obs_horizon=2))
    first, _ = envs.reset(seed=[1, 2][:num_envs])
    assert first.shape[:2] == (num_envs, 2)
    for _ in range(2):
        obs, *_, truncated, info = envs.step(np.zeros((num_envs, 6), np.float32))
    after, *_, info_after = envs.step(np.zeros((num_envs, 6), np.float32))
    envs.close()
    assert truncated.all()
    episode = info["final_info"]["episode"]
    assert episode["episode_len"].tolist() == [2] * num_envs
    assert episode["success_at_end"].tolist() == [False] * num_envs
    assert {"success_once", "fail_once", "fail_at_end", "return", "reward"} <= set(episode)
    # the step that ends an episode begins the next one, and so none is without an action
    assert np.array_equal(obs[:, 0], obs[:, 1])
    assert not np.array_equal(after[:, 0], after[:, 1])
    assert info_after["elapsed_steps"].tolist() == [1] * num_envs


@pytest.mark.parametrize("num_envs", [1, 2])
def test_observations_of_touch_are_stacked_once_they_are_flat(num_envs):
    kwargs = dict(obs_mode="tacff", render_backend="none", max_episode_steps=2)
    stacked = dict(env_kwargs=kwargs, other_kwargs=dict(obs_horizon=2))
    envs = make_eval_envs(PEG, num_envs, **stacked, wrappers=[FlattenVisuotactileObservationWrapper])
    first, _ = envs.reset(seed=[1, 2][:num_envs])
    envs.close()
    assert {name: part.shape for name, part in first.items()} == dict(state=(num_envs, 2, 25), tacff=(num_envs, 2, 10, 14, 3))
    with pytest.raises(InvalidArgumentError, match=r"obs_horizon=2: .* nested; give wrappers=\[FlattenVisuotactile"):
        make_eval_envs(PEG, num_envs, **stacked)


@needs_renderer
def test_an_evaluation_environment_makes_a_video_of_each_episode(tmp_path):
    kwargs = dict(obs_mode="state", render_mode="rgb_array", max_episode_steps=2)
    envs = make_eval_envs(PEG, 1, env_kwargs=kwargs, video_dir=tmp_path)
    envs.reset(seed=1)
    for _ in range(4):
        envs.step(np.zeros((1, 6), np.float32))
    envs.close()
    assert [len(imread(video)) for video in tmp_path.glob("*.mp4")] == [3, 3]  # images of the reset and of both steps


@pytest.mark.parametrize("wrappers", [[], [CPUGymWrapper]], ids=["plain", "CPUGymWrapper"])
def test_gymnasium_makes_a_vector_of_spawned_processes(wrappers):
    kwargs = dict(obs_mode="tacff", render_backend="none")
    envs = gym.make_vec(PEG, 2, vectorization_mode="async", vector_kwargs=dict(context="spawn"), wrappers=wrappers, **kwargs)
    obs, _ = envs.reset(seed=0)
    assert obs["sensor_data"]["tactile_right"]["force_field"].shape[0] == 2
    _, rewards, *_ = envs.step(envs.action_space.sample())
    envs.close()
    assert np.isfinite(rewards).all()


def test_a_seed_of_the_policy_gives_other_noise(tmp_path):
    checkpoint, (request,) = save_tiny_checkpoint(tmp_path / "1"), requests(1)
    first, other, again = (
        PolicySource(checkpoint, kwargs=kwargs, device="cpu", batch_size=1).make().answer([request])[0]
        for kwargs in ("{}", '{"seed": 5}', '{"seed": 0}')
    )
    assert not np.allclose(first, other, atol=1e-3)
    np.testing.assert_array_equal(first, again)
