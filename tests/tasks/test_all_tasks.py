"""What holds for every task."""

import re
from contextlib import closing
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.utils.wrappers import CPUGymWrapper

import manifeel_ms3.experts  # noqa: F401
from manifeel_ms3.agents import PandaGelSight
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.tasks.registry import FIRST_EVALUATION_SEED, all_tasks, evaluation_seeds

TASKS = sorted(name for name in gym.registry if name.startswith("ManiFeel-"))


def test_every_task_has_a_demonstrator():
    assert set(all_tasks()) == set(TASKS)
    assert all(spec.demonstrator is not None for spec in all_tasks().values())


def test_evaluation_seeds_are_the_papers_and_disjoint_from_those_of_demonstrations():
    assert evaluation_seeds(50) == list(range(100_000, 100_050))
    assert min(evaluation_seeds(3)) >= FIRST_EVALUATION_SEED
    with pytest.raises(InvalidArgumentError, match="at least 1"):
        evaluation_seeds(0)


def test_every_task_has_one_sentence_that_says_what_to_do():
    for spec in all_tasks().values():
        assert re.fullmatch(r"[A-Z][^.]+\.", spec.instruction), spec.env_id
        assert "ManiFeel" not in spec.instruction


def test_the_sentence_comes_with_the_environment_and_with_its_resets(make_env):
    env = make_env("ManiFeel-PegInsertion-v1", obs_mode="none", render_backend="none")
    sentence = all_tasks()["ManiFeel-PegInsertion-v1"].instruction
    assert env.unwrapped.get_language_instruction() == [sentence]
    assert env.reset(seed=0)[1]["language_instruction"] == [sentence]
    _, info = CPUGymWrapper(env).reset(seed=0)
    assert info["language_instruction"] == sentence


@pytest.mark.parametrize("task", TASKS)
def test_no_success_at_reset_or_by_chance(make_env, task):
    env = make_env(task, obs_mode="none", render_backend="none")
    rng = np.random.default_rng(0)
    for seed in range(8):
        _, info = env.reset(seed=seed)
        assert not info["success"].any()
        assert not info["fail"].any()
        assert info["contact_force"].isfinite().all()
    for _ in range(40):
        *_, info = env.step(rng.uniform(-1, 1, env.action_space.shape))
        assert not info["success"].any()


@pytest.mark.parametrize("task", TASKS)
def test_observations_keep_the_contract_and_hold_nothing_privileged(make_env, task):
    env = make_env(task, obs_mode="tacrgb+tacff", render_backend="none", tactile_sensors=("left", "right"))
    obs, _ = env.reset(seed=0)
    assert set(obs["extra"]) == {"tcp_pose"}
    assert set(obs["sensor_data"]) == {"tactile_left", "tactile_right"}
    for pad in obs["sensor_data"].values():
        assert pad["rgb"].shape == (1, 240, 320, 3)
        assert pad["rgb"].dtype == torch.uint8
        assert pad["force_field"].shape == (1, 10, 14, 3)


@pytest.mark.parametrize("sensor", ["gelsight_mini", "digit"])
@pytest.mark.parametrize("task", [f"ManiFeel-{name}-v1" for name in ("PegInsertion", "BulbInstallation", "BallSorting")])
def test_other_sensors_feel_what_the_engine_puts_on_the_pad(make_env, task, sensor):
    """With a flat part, and with round ones, on pads that are five boxes or a dome."""
    env = make_env(task, obs_mode="tacff", render_backend="none", sensor=sensor)
    env.reset(seed=0)
    still = np.zeros(env.action_space.shape)
    if task == "ManiFeel-BallSorting-v1":  # it begins with an empty hand
        env.unwrapped.golf._bodies[0].set_disable_gravity(True)
        env.unwrapped.golf.set_pose(env.unwrapped.agent.tcp.pose)
        still[-1] = -1.0
    for _ in range(5):
        obs = env.step(still)[0]
    rows, cols, normal = env.unwrapped.agent.pad_wrench("right")[0, :3].tolist()
    felt = obs["sensor_data"]["tactile_right"]["force_field"][0].sum((0, 1)).tolist()
    assert felt[0] > 5.0  # N
    assert felt == pytest.approx([-normal, rows, cols], abs=0.005 * abs(normal))


@pytest.mark.parametrize("task", TASKS)
def test_task_says_what_it_is(task):
    doc = all_tasks()[task].env_class.__doc__
    if task == "ManiFeel-BallSortingDim-v1":
        assert "BallSorting at 5 % of the light" in doc
    else:
        assert all(heading in doc for heading in ("Task Description", "Randomizations", "Success Conditions"))


@cache
def largest_ranges(task: str) -> dict[str, tuple[float, str]]:
    """Largest randomization of each kind that a task takes, and the reason."""
    with closing(gym.make(task, obs_mode="none", render_backend="none")) as env:
        return env.unwrapped._largest_ranges()


@pytest.mark.parametrize("task", TASKS)
def test_ranges_as_large_as_allowed_give_sound_starts(make_env, monkeypatch, task):
    """At the limits nothing lies in anything else, and the hand is where it is to start."""
    starts, reset_tool = [], PandaGelSight.reset_tool
    monkeypatch.setattr(PandaGelSight, "reset_tool", lambda *args, **kw: (starts.append(args[1]), reset_tool(*args, **kw)))
    limits = {name: 0.999 * limit for name, (limit, _) in largest_ranges(task).items()}
    assert set(limits) == set(all_tasks()[task].env_class.Randomization.__dataclass_fields__)
    env = make_env(task, obs_mode="none", render_backend="none", randomization=limits)
    for seed in range(6):
        env.reset(seed=seed)
        moved = env.unwrapped.agent.tcp_pose_at_base.p - starts[-1].p
        assert moved.norm() < 0.001, seed  # the arm sags by up to 0.9 mm under what the hand holds
        *_, info = env.step(np.zeros(env.action_space.shape))
        assert not info["fail"].any(), seed
        assert float(info["contact_force"]) < 8.0, seed


@pytest.mark.parametrize("task", TASKS)
def test_ranges_that_cannot_be_played_are_refused_at_construction(make_env, task):
    for name, (limit, reason) in largest_ranges(task).items():
        with pytest.raises(ValueError, match=name) as error:
            make_env(task, obs_mode="none", render_backend="none", randomization={name: 1.01 * limit})
        assert reason in str(error.value)
        shown = float(re.search(r"at most (\S+):", str(error.value))[1])
        assert 0.99 * limit < shown <= limit, "the value that the message gives is refused itself"
