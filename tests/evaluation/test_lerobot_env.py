"""The tasks as LeRobot sees them. Its own library drives them in `test_lerobots_own_evaluation`, where it is installed."""

import importlib.util
import json
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv

from manifeel_ms3.errors import InvalidArgumentError, UnknownNameError
from manifeel_ms3.evaluation.lerobot_env import GYM_ID, LeRobotEnv, make_env
from manifeel_ms3.tasks.registry import task_spec
from tests.tasks_and_marks import PEG, needs_renderer

SMALL = dict(sensor_configs=dict(width=32, height=32))
HAS_LEROBOT = importlib.util.find_spec("lerobot") is not None


def test_the_file_of_the_envhub_has_the_function_that_lerobot_calls():
    path = Path(__file__).parents[2] / "examples/lerobot_envhub/env.py"
    assert runpy.run_path(str(path))["make_env"] is make_env


@pytest.fixture(scope="module")
def env():
    made = gym.make(GYM_ID, env_id=PEG, obs_mode="tacrgb+tacff", env_kwargs=dict(render_backend="none"))
    yield made
    made.close()


def test_observations_and_attributes_are_those_that_lerobot_reads(env):
    obs, info = env.reset(seed=7, options={"lerobot_new_rollout": True})
    assert env.observation_space.contains(obs)
    assert obs["pixels"]["tactile_right"].shape == (240, 320, 3)
    assert obs["agent_pos"].shape == (7,)
    assert obs["tactile.right.force_field"].shape == (10, 14, 3)
    assert info["is_success"] is False
    assert (env.task, env.task_description) == ("PegInsertion", "Insert the peg into the hole.")
    assert env._max_episode_steps == task_spec(PEG).max_episode_steps
    assert env.metadata["render_fps"] == 10


def test_an_episode_depends_on_its_seed_and_ends_at_the_time_limit(env):
    first, _ = env.reset(seed=100_000)
    again, _ = env.reset(seed=100_000)
    other, _ = env.reset(seed=100_001)
    assert np.array_equal(first["agent_pos"], again["agent_pos"])
    assert not np.array_equal(first["agent_pos"], other["agent_pos"])
    short = LeRobotEnv(PEG, "tacff", dict(render_backend="none", max_episode_steps=2, sim_config=dict(control_freq=20)))
    assert short.metadata["render_fps"] == 20
    assert short._max_episode_steps == 2
    short.reset(seed=1)
    still = np.zeros(short.action_space.shape, np.float32)
    assert [short.step(still)[2:4] for _ in range(2)] == [(False, False), (False, True)]
    short.close()


def test_several_tasks_make_suites_of_vectorised_environments():
    cfg = SimpleNamespace(task=f"{PEG},ManiFeel-ObjectSearch-v1", obs_mode="tacff", env_kwargs=dict(render_backend="none"))
    suites = make_env(cfg=cfg)
    assert {suite: list(envs) for suite, envs in suites.items()} == {"insertion": [0], "exploration": [0]}
    assert suites["exploration"][0].call("task") == ("ObjectSearch",)
    envs = suites["insertion"][0]
    obs, _ = envs.reset(seed=[100_000])
    assert obs["agent_pos"].shape == (1, 7)
    assert envs.call("task_description") == ("Insert the peg into the hole.",)
    assert envs.step(np.zeros(envs.action_space.shape))[4]["is_success"].tolist() == [False]
    for suite in suites.values():
        suite[0].close()


def test_several_environments_of_a_task_have_processes_of_their_own_if_asked():
    cfg = SimpleNamespace(task=PEG, obs_mode="tacff", env_kwargs=dict(render_backend="none", max_episode_steps=1))
    envs = make_env(n_envs=2, use_async_envs=True, cfg=cfg)["insertion"][0]
    assert isinstance(envs, AsyncVectorEnv)
    assert len({process.pid for process in envs.processes}) == 2
    obs, _ = envs.reset(seed=[100_000, 100_001])
    assert not np.allclose(*obs["agent_pos"])
    assert envs.call("task_description") == ("Insert the peg into the hole.",) * 2
    *_, truncated, info = envs.step(np.zeros(envs.action_space.shape, np.float32))
    assert truncated.tolist() == [True, True]
    assert info["final_info"]["is_success"].tolist() == [False, False]
    envs.close()


def test_what_cannot_be_made_is_said():
    with pytest.raises(UnknownNameError, match="'Nothing-v1' is not registered"):
        make_env(cfg=SimpleNamespace(task="Nothing-v1"))
    with pytest.raises(InvalidArgumentError, match="n_envs=0"):
        make_env(n_envs=0)
    for mode in ("state+tacff", "state_dict", "none"):
        with pytest.raises(InvalidArgumentError, match="holds the simulation's state"):
            LeRobotEnv(PEG, mode)


@needs_renderer
@pytest.mark.skipif(not HAS_LEROBOT, reason="lerobot is not installed")
def test_lerobots_own_evaluation_drives_a_task(tmp_path):
    """`lerobot-eval` with a policy of its own that has not been trained."""
    task = dict(SMALL, max_episode_steps=3)
    command = [
        *(sys.executable, "-m", "lerobot.scripts.lerobot_eval"),
        "--env.discover_packages_path=manifeel_ms3.evaluation.lerobot_plugin",
        *("--env.type=manifeel", f"--env.task={PEG}", "--env.obs_mode=rgb+tacrgb", f"--env.env_kwargs={json.dumps(task)}"),
        *("--policy.type=act", "--policy.pretrained_backbone_weights=null", "--policy.device=cpu"),
        *("--policy.push_to_hub=false", "--policy.dim_model=32", "--policy.n_heads=2", "--policy.dim_feedforward=32"),
        *("--eval.n_episodes=2", "--eval.batch_size=2", "--seed=100000", f"--output_dir={tmp_path}"),
    ]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr[-3000:]
    overall = json.loads((tmp_path / "eval_info.json").read_text())["overall"]
    assert (overall["n_episodes"], overall["pc_success"]) == (2, 0.0)
