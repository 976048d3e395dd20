"""The demonstrator wins by the policy's own means."""

import numpy as np
import pytest

from manifeel_ms3.experts import make_expert
from tests.conftest import PEG


@pytest.mark.parametrize("fit", ["tight", "loose"])
def test_expert_succeeds_gently_within_the_action_limits(make_env, fit):
    env = make_env(obs_mode="none", render_backend="none", fit=fit)
    for seed in range(6):
        env.reset(seed=seed)
        actions, peak = [], 0.0
        for action in make_expert(PEG, env.unwrapped, seed).actions():
            *_, terminated, truncated, info = env.step(action)
            actions.append(action)
            peak = max(peak, float(info["contact_force"]))
            if terminated or truncated:
                break
        assert info["success"].all(), f"seed {seed}"
        assert np.abs(actions).max() <= 1.0
        assert peak < 60.0
        assert len(actions) < 150


def test_expert_feels_the_rim(make_env):
    """It goes on only after touch: with the socket taken away, it finds nothing to stand the peg up in."""
    env = make_env(obs_mode="none", render_backend="none", fit="loose")
    env.reset(seed=0)
    expert = make_expert(PEG, env.unwrapped, 0)
    from mani_skill.utils.structs import Pose

    away = env.unwrapped.socket.pose.raw_pose.clone()
    away[:, 0] += 0.2
    env.unwrapped.socket.set_pose(Pose.create(away))
    for _, action in zip(range(120), expert.actions(), strict=False):
        *_, info = env.step(action)
    assert not info["success"].any()


def test_unknown_task_names_those_that_have_an_expert(make_env):
    env = make_env(obs_mode="none", render_backend="none")
    with pytest.raises(ValueError, match=PEG):
        make_expert("ManiFeel-Juggling-v1", env.unwrapped, 0)
