"""The presets `paper` as they are: their networks, a step of training, and an action."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from baselines.common.agent import spec_of
from baselines.common.checkpoint import save_checkpoint
from baselines.common.observation import POSE
from baselines.common.processes import Processes
from baselines.common.training import Trainer
from baselines.diffusion_policy import train as diffusion
from baselines.equivariant_diffusion_policy import train as equivariant
from baselines.flow_matching import train as flow
from manifeel_ms3.demonstrations import read_demonstrations
from tests.sample import observed_sample
from tests.tasks_and_marks import PEG

SPECS = pytest.mark.parametrize("spec", [diffusion.SPEC, equivariant.SPEC, flow.SPEC], ids=lambda spec: spec.name)
SAMPLE = observed_sample(PEG)
CAMERA, FIELD = "sensor_data/wrist/rgb", "sensor_data/tactile_right/force_field"


@SPECS
def test_networks_take_the_papers_observations(spec):
    """On the device "meta", which computes shapes alone."""
    args = dataclasses.replace(spec.presets["paper"].args, obs_mode="rgb+tacrgb+tacff", env_id=PEG).with_task_defaults()
    observed, horizon, batch = spec_of(vars(args)), args.policy.obs_horizon, args.batch_size
    with torch.device("meta"):
        policy = spec.policy_class(args.policy, observed, 6)
        obs = {key: torch.zeros(batch, horizon, 256, 256, 3, dtype=torch.uint8) for key in observed.images}
        obs |= {key: torch.zeros(batch, horizon, 10, 14, 3) for key in observed.force_fields}
        pose = {POSE: torch.zeros(batch, horizon, observed.pose_features)}
        condition = policy.condition(obs | pose)
        assert policy(obs | pose, torch.zeros(batch, 16, 6)).shape == ()
    per_step = 128 if spec is equivariant.SPEC else 512 + 512 + 512 + 7
    assert condition.shape[-1] == horizon * per_step


@pytest.mark.slow
@SPECS
def test_a_step_of_training_and_an_action(spec, tmp_path):
    small = dict(demos=(SAMPLE,), num_demos=1, image_size=64, batch_size=2, steps=3, warmup_steps=0, run_dir=tmp_path / "run")
    args = dataclasses.replace(spec.presets["paper"].args, **small, device="cpu", precision="fp32", compile=False)
    trainer = Trainer(args, spec.policy_class, Processes("cpu"))
    before = {name: weights.detach().clone() for name, weights in trainer.policy.encoder.named_parameters()}
    for _ in range(2):  # at first some layers have no gradient, because those after them begin at 0
        trainer.take_step()
    changed = [name for name, weights in trainer.policy.encoder.named_parameters() if not torch.equal(weights, before[name])]
    assert len(changed) == len(before)
    save_checkpoint(tmp_path / "checkpoint", trainer.config, trainer.policy.state_dict(), {})
    del trainer
    agent = spec.load(tmp_path / "checkpoint", inference_steps=2)
    action = agent.act(first_observation())
    assert action.shape == (6,)
    assert np.isfinite(action).all()


def first_observation() -> dict[str, Any]:
    """The first observation of a demonstration in the form in which the environment gives it."""
    keys = [CAMERA, FIELD, POSE]
    (episode,) = read_demonstrations(SAMPLE, keys, num=1)
    first = {key: torch.as_tensor(episode[key][:1]) for key in keys}
    sensors = {"wrist": {"rgb": first[CAMERA]}, "tactile_right": {"force_field": first[FIELD]}}
    return dict(sensor_data=sensors, extra=dict(tcp_pose=first[POSE]))
