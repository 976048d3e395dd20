"""Evaluated episodes can be filmed whatever the policy observes."""

import json

import numpy as np
import pytest
import torch

from manifeel_ms3 import cli
from manifeel_ms3.evaluation import evaluate, video
from manifeel_ms3.evaluation.rollout import evaluate_episode
from manifeel_ms3.evaluation.video import act_again, record_episode
from manifeel_ms3.workers import torch_threads
from tests.evaluation import policies
from tests.tasks_and_marks import PEG, needs_renderer

STEPS = 6
SHOWN = {"wrist", "front", "tactile right: TacRGB", "tactile right: TacFF"}


@needs_renderer
@pytest.mark.parametrize("obs_mode", ["state", "state_dict", "depth+tacff", "tacff"])
def test_a_policy_is_filmed_on_its_own_observations(make_env, obs_mode):
    given = dict(obs_mode=obs_mode, cameras=["wrist"], max_episode_steps=STEPS, sim_backend="physx_cpu")
    evaluated = evaluate_episode(make_env(**given), policies.FollowsAllItSees(), seed=3)
    assert evaluated.error is None
    outcome, frames = record_episode(PEG, given, policies.FollowsAllItSees(), 3)
    assert (outcome.return_, outcome.peak_contact_force) == (evaluated.return_, evaluated.peak_contact_force)
    assert len(frames) == STEPS + 1
    assert all(set(frame) == SHOWN for frame in frames)
    assert not np.array_equal(frames[0]["front"], frames[-1]["front"])


def test_a_policy_that_hangs_is_not_waited_for():
    given = dict(obs_mode="state", render_backend="none", sim_backend="physx_cpu")
    outcome, actions = act_again(PEG, given, policies.Sleeps(), 3, step_timeout=1.0)
    assert "no answer within 1 s" in outcome.error
    assert not actions


def test_what_is_run_again_leaves_the_threads_of_torch_as_they_were(monkeypatch):
    monkeypatch.setattr(video, "evaluate_episode", lambda *_: torch.get_num_threads())
    with torch_threads(3):
        threads, _ = act_again(PEG, dict(obs_mode="state", render_backend="none", sim_backend="physx_cpu"), None, 3)
        assert (threads, torch.get_num_threads()) == (1, 3)


@needs_renderer
def test_an_evaluation_without_a_renderer_is_filmed_with_one(tmp_path):
    bare = json.dumps(dict(render_backend="none", max_episode_steps=STEPS))
    policy, out = "tests.evaluation.policies:FollowsAllItSees", tmp_path / "evaluation.json"
    args = evaluate.Args(policy=policy, env_id=PEG, obs_mode="state", env_kwargs=bare, episodes=1, out=out, videos=(0,))
    evaluate.main(args)
    assert (tmp_path / "videos/100000.mp4").stat().st_size > 1000
    film = tmp_path / "film.webp"
    assert cli.main(["film", str(out), "--policy", policy, "--out", str(film), "--max-frames", "2", "--width", "524"]) == 0
    assert film.stat().st_size > 1000
