"""Every policy, in every sensing set-up, learns one demonstration by heart and does it again in the simulator."""

import dataclasses
import json
from pathlib import Path

import pytest

from baselines.common.agent import PolicyAgent
from baselines.diffusion_policy import train as diffusion
from baselines.equivariant_diffusion_policy import train as equivariant
from baselines.flow_matching import train as flow
from manifeel_ms3.demonstrations import record
from manifeel_ms3.evaluation.rollout import evaluate_episode
from tests.conftest import PEG, needs_renderer

pytestmark = [pytest.mark.slow, needs_renderer]
SEED = 0
LOOSE = dict(fit="loose")  # the tight one takes this seed a search of 100 steps, which no copy of its motions repeats


@pytest.fixture(scope="module")
def demonstration(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("demo") / "trajectory.h5"
    sensing = dict(obs_mode="rgb+tacrgb+tacff", cameras=("wrist",), tactile_sensors=("right",), env_kwargs=json.dumps(LOOSE))
    return record.main(record.Args(PEG, 1, 1, SEED, path, **sensing))


@pytest.mark.parametrize("mode", ["rgb", "rgb+tacrgb", "rgb+tacff"])
@pytest.mark.parametrize("script", [diffusion, equivariant, flow], ids=["diffusion", "equivariant", "flow"])
def test_one_demonstration_is_learnt_by_heart(make_env, demonstration, tmp_path, script, mode):
    cpu = script.PRESETS["cpu"][1]
    encoder = dataclasses.replace(cpu.policy.encoder, crop=0)
    policy = dataclasses.replace(cpu.policy, encoder=encoder, pose_noise=0.0)  # nothing that is to help with other starts
    args = dataclasses.replace(
        cpu, demos=(demonstration,), obs_mode=mode, policy=policy, batch_size=32, steps=800, run_dir=tmp_path
    )
    checkpoint = script.main(args)
    env = make_env(PEG, obs_mode=mode, cameras=("wrist",), tactile_sensors=("right",), **LOOSE)
    outcome = evaluate_episode(env, PolicyAgent(checkpoint), SEED)
    assert outcome.success_once
