"""No success without skill: many resets, many episodes of random actions. An hour; run it with `pytest -m slow`."""

import numpy as np
import pytest

from manifeel_ms3.demonstrations.dataset import PAPER_COUNTS

pytestmark = pytest.mark.slow
TASKS = sorted(PAPER_COUNTS)


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
    env = make_env(task, obs_mode="none", render_backend="none")
    rng = np.random.default_rng(0)
    for seed in range(100):
        env.reset(seed=seed)
        ended = False
        while not ended:
            *_, terminated, truncated, info = env.step(rng.uniform(-1, 1, env.action_space.shape))
            assert not info["success"].any(), seed
            ended = bool(terminated) or bool(truncated)
