"""Evaluation with the policy on a CUDA GPU; without one, the same on the CPU shows that the test itself works."""

import json

import numpy as np
import pytest

from manifeel_ms3.evaluation.evaluate import Args, main
from manifeel_ms3.evaluation.result import read_result
from tests.tasks_and_marks import ON_GPU, PEG
from tests.trust.tiny_checkpoint import save_tiny_checkpoint

BARE = json.dumps(dict(render_backend="none", max_episode_steps=6))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=ON_GPU)])
def test_two_episodes_are_evaluated_with_the_policy_on_a_device(device, tmp_path):
    checkpoint = save_tiny_checkpoint(tmp_path / "checkpoint")
    config = json.loads((checkpoint / "config.json").read_text())
    (checkpoint / "config.json").write_text(json.dumps(config | dict(env_id=PEG)))
    args = Args(checkpoint=checkpoint, device=device, episodes=2, env_kwargs=BARE, out=tmp_path / "evaluation.json")
    result = read_result(main(args))
    assert result["inference"]["device"] == device
    assert [(episode["episode_len"], episode["error"]) for episode in result["episodes"]] == [(6, None)] * 2
    assert np.isfinite([episode["return"] for episode in result["episodes"]]).all()
