"""Evaluation: fixed seeds, honest intervals, identical outcomes, a page that opens."""

import numpy as np
import pytest

from manifeel_ms3.evaluation import evaluate_episode
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError
from manifeel_ms3.evaluation.policy import load_policy
from manifeel_ms3.evaluation.statistics import wilson_interval
from manifeel_ms3.experts import make_expert
from manifeel_ms3.tasks.registry import evaluation_seeds
from tests.conftest import PEG


class ExpertPolicy:
    """The demonstrator behind the policy interface: the loop around it is what is tested."""

    def __init__(self, env, seed):
        self.env, self.seed = env, seed

    def reset(self):
        self.actions = make_expert(PEG, self.env.unwrapped, self.seed).actions()

    def act(self, obs):
        return next(self.actions)


class StandStill:
    def reset(self):
        pass

    def act(self, obs):
        return np.zeros(6)


def test_outcome_of_a_success_and_of_a_failure(make_env):
    env = make_env(obs_mode="none", render_backend="none", fit="paper")
    won = evaluate_episode(env, ExpertPolicy(env, 1), seed=1)
    assert won.success_once
    assert won.success_at_end
    assert won.length < 150
    assert 5 < won.peak_contact_force < 60
    lost = evaluate_episode(env, StandStill(), seed=1)
    assert not lost.success_once
    assert lost.length == 300


def test_same_policy_and_seed_give_the_same_outcome(make_env):
    env = make_env(obs_mode="none", render_backend="none", fit="paper")
    first = evaluate_episode(env, ExpertPolicy(env, 2), seed=2)
    evaluate_episode(env, ExpertPolicy(env, 3), seed=3)
    again = evaluate_episode(env, ExpertPolicy(env, 2), seed=2)
    assert first.error is None
    assert first.length > 0
    assert (first.length, first.peak_contact_force) == (again.length, again.peak_contact_force)


def test_wilson_interval_matches_published_values():
    # Newcombe 1998, table I, method 3: 81/263 and 0/20
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


def test_evaluation_seeds_are_fixed_and_counted():
    seeds = evaluation_seeds(50)
    assert len(set(seeds)) == 50
    assert min(seeds) > 10_000  # demonstrations start at 0
    assert evaluation_seeds(10) == seeds[:10]
    with pytest.raises(ValueError, match="0 evaluation episodes are asked for; at least 1"):
        evaluation_seeds(0)


@pytest.mark.parametrize(
    ("config", "word"),
    [
        (None, "no config.json"),
        ("{", "not json"),
        ("[]", "holds a list instead of an object"),
        ('{"policy_name": "juggler"}', "'juggler' is not registered .*diffusion_policy.*install the package"),
        (
            '{"kind": "baselines.common.agent:PolicyAgent", "policy_class": "nowhere:Policy"}',  # as commit 721bfa4 wrote it
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
