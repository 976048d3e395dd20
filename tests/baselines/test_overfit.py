"""Every policy, in every sensing set-up, memorises one demonstration and repeats it in the simulator."""

import dataclasses
from pathlib import Path

import pytest

from baselines.diffusion_policy import train as diffusion
from baselines.equivariant_diffusion_policy import train as equivariant
from baselines.flow_matching import train as flow
from manifeel_ms3.demonstrations import record
from manifeel_ms3.evaluation.rollout import evaluate_episode
from tests.tasks_and_marks import needs_renderer

pytestmark = [pytest.mark.slow, needs_renderer]
TASK = "ManiFeel-BallSorting-v1"
SEED = 0  # its demonstration is short, because the first ball that it tries is the right one
SENSORS = dict(cameras=("front",), tactile_sensors=("right",))


@pytest.fixture(scope="module")
def demonstration(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("demo") / "trajectory.h5"
    return record.main(record.Args(TASK, 1, 1, SEED, path, obs_mode="rgb+tacrgb+tacff", **SENSORS))


@pytest.mark.parametrize("mode", ["rgb", "rgb+tacrgb", "rgb+tacff"])
@pytest.mark.parametrize("script", [diffusion, equivariant, flow], ids=["diffusion", "equivariant", "flow"])
def test_one_demonstration_is_memorised_and_repeated(make_env, demonstration, tmp_path, script, mode):
    cpu = script.PRESETS["cpu"].args
    # without the crops and the noise on the pose that help with other starts, and with the paper's horizons
    alike = dict(encoder=dataclasses.replace(cpu.policy.encoder, crop=0), pose_noise=0.0, noise_draws=1)
    policy = dataclasses.replace(cpu.policy, obs_horizon=2, action_horizon=8, **alike)
    run = dict(demos=(demonstration,), env_id=TASK, obs_mode=mode, run_dir=tmp_path, **SENSORS)
    checkpoint = script.main(dataclasses.replace(cpu, policy=policy, batch_size=16, steps=1500, **run))
    env = make_env(TASK, obs_mode=mode, **SENSORS)
    outcome = evaluate_episode(env, script.SPEC.load(checkpoint), SEED)
    assert outcome.success_once
