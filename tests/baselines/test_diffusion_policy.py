"""Diffusion Policy: it learns, it saves, it resumes, it refuses what is not its own."""

import dataclasses
import json
import shutil

import pytest
import torch

from baselines.common.checkpoint import read_tensors
from baselines.common.encoders import EncoderConfig
from baselines.diffusion_policy import train
from baselines.diffusion_policy.agent import DiffusionPolicyAgent
from baselines.diffusion_policy.policy import PolicyConfig
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError, checkpoint_config
from tests.conftest import PEG


@pytest.fixture(scope="module")
def args(demos, tmp_path_factory):
    small = PolicyConfig(encoder=EncoderConfig(force_field="small"), channels=(32, 64), step_embedding=32, diffusion_steps=20)
    return train.Args(
        demos=(demos,),
        obs_mode="tacff",
        cameras=(),
        policy=small,
        inference_steps=20,
        batch_size=32,
        steps=120,
        lr=1e-3,
        warmup_steps=5,
        save_every=60,
        log_every=30,
        device="cpu",
        run_dir=tmp_path_factory.mktemp("run"),
    )


@pytest.fixture(scope="module")
def checkpoint(args):
    return train.main(args)


def test_presets_hold_the_papers_hyperparameters():
    paper = train.PRESETS["paper"][1]
    assert (paper.policy.obs_horizon, paper.policy.action_horizon, paper.policy.pred_horizon) == (2, 8, 16)
    assert (paper.lr, paper.betas, paper.weight_decay, paper.warmup_steps, paper.batch_size) == (
        8e-5,
        (0.95, 0.999),
        1e-6,
        500,
        8,
    )
    assert (paper.policy.diffusion_steps, paper.inference_steps) == (100, 100)
    assert paper.policy.channels == (512, 1024, 2048)
    assert (paper.policy.encoder.image, paper.policy.encoder.force_field, paper.image_size) == (
        "resnet18",
        "resnet18",
        256,
    )


def test_loss_falls(args, checkpoint):
    log = [json.loads(line) for line in (args.run_dir / "log.jsonl").read_text().splitlines()]
    assert [entry["step"] for entry in log] == [30, 60, 90, 120]
    assert log[-1]["loss"] < 0.8 * log[0]["loss"]


def test_checkpoint_is_json_and_safetensors(checkpoint):
    assert {file.name for file in checkpoint.iterdir()} == {"config.json", "model.safetensors", "training.safetensors"}
    assert checkpoint_config(checkpoint)["step"] == 120


def test_resumed_training_equals_uninterrupted(args, checkpoint, tmp_path):
    halves = dataclasses.replace(args, run_dir=tmp_path, steps=120)

    class Stop(Exception):
        pass

    saves = []
    original = train.save_checkpoint

    def save_then_stop(*arguments):
        original(*arguments)
        saves.append(1)
        raise Stop

    train.save_checkpoint = save_then_stop
    try:
        with pytest.raises(Stop):
            train.main(halves)
    finally:
        train.save_checkpoint = original
    assert checkpoint_config(tmp_path / "checkpoints/last")["step"] == 60
    resumed = train.main(dataclasses.replace(halves, resume=True))
    assert checkpoint_config(resumed)["step"] == 120
    whole, second = read_tensors(checkpoint / "model.safetensors"), read_tensors(resumed / "model.safetensors")
    assert all(torch.allclose(whole[name], second[name], atol=1e-6) for name in whole)


def test_resume_with_other_settings_names_them(args, checkpoint):
    with pytest.raises(CheckpointError, match=r"lr: 0.001 there, 0.5 now"):
        train.main(dataclasses.replace(args, resume=True, lr=0.5))


def test_resume_without_a_checkpoint(args, tmp_path):
    with pytest.raises(CheckpointError, match="config.json"):
        train.main(dataclasses.replace(args, resume=True, run_dir=tmp_path))


def test_agent_acts_and_repeats_itself_after_reset(make_env, checkpoint):
    env = make_env(PEG, obs_mode="tacff", render_backend="none")
    agent = DiffusionPolicyAgent(checkpoint)
    obs, _ = env.reset(seed=0)
    first = [agent.act(obs) for _ in range(10)]
    agent.reset()
    second = [agent.act(obs) for _ in range(10)]
    assert all(a.shape == (6,) and (a == b).all() for a, b in zip(first, second, strict=True))
    few = DiffusionPolicyAgent(checkpoint, inference_steps=4)
    assert few.act(obs).shape == (6,)


def test_checkpoint_of_another_architecture_is_refused(checkpoint, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(checkpoint, other)
    config = checkpoint_config(other)
    config["policy"]["channels"] = [16, 32]
    (other / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match="another architecture"):
        DiffusionPolicyAgent(other)


def test_checkpoint_of_another_policy_is_refused(checkpoint, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(checkpoint, other)
    (other / "config.json").write_text(json.dumps(dict(kind="something:Else")))
    with pytest.raises(CheckpointError, match="not one of a Diffusion Policy"):
        DiffusionPolicyAgent(other)


def test_truncated_weights_are_refused(checkpoint, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(checkpoint, other)
    (other / "model.safetensors").write_bytes((checkpoint / "model.safetensors").read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="cannot be read"):
        DiffusionPolicyAgent(other)
