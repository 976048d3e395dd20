"""No success without skill: many resets, many episodes of random actions. Two hours; run it with `pytest -m slow`."""

import gymnasium as gym
import numpy as np
import pytest

from manifeel_ms3.experts.skills import Skills
from manifeel_ms3.tasks.registry import all_tasks

pytestmark = pytest.mark.slow
TASKS = sorted(all_tasks())


@pytest.mark.parametrize("task", TASKS)
def test_no_success_at_a_thousand_resets(make_env, task):
    env = make_env(task, obs_mode="none", render_backend="none")
    for seed in range(1000):
        _, info = env.reset(seed=seed)
        assert not info["success"].any(), seed
        assert not info["fail"].any(), seed
        assert not env.unwrapped.goal_reached(env.unwrapped.measure()).any(), seed


@pytest.mark.parametrize("task", TASKS)
def test_no_success_in_a_hundred_random_episodes(make_env, task):
    _random_episodes(make_env(task, obs_mode="none", render_backend="none"))


@pytest.mark.parametrize("task", ["ManiFeel-BulbInstallation-v1", "ManiFeel-NutBoltAssembly-v1"])
def test_no_success_in_a_hundred_random_episodes_that_keep_hold(make_env, task):
    """Random fingers drop the part in the first steps; held as the demonstrator holds it, it stays about the thread."""
    env = make_env(task, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    screw = env.unwrapped.screw
    lengths = _random_episodes(env, gripper=Skills(env.unwrapped).grip_action(screw.grip_width, screw.grip_force))
    assert np.mean(lengths) > 0.5 * gym.spec(task).max_episode_steps


def _random_episodes(env, gripper: float | None = None) -> list[int]:
    """Numbers of steps of a hundred episodes without success; the gripper's action is random, too, unless it is given."""
    rng = np.random.default_rng(0)
    lengths = []
    for seed in range(100):
        env.reset(seed=seed)
        lengths.append(0)
        ended = False
        while not ended:
            action = rng.uniform(-1, 1, env.action_space.shape)
            if gripper is not None:
                action[-1] = gripper
            *_, terminated, truncated, info = env.step(action)
            assert not info["success"].any(), seed
            ended = bool(terminated) or bool(truncated)
            lengths[-1] += 1
    return lengths
