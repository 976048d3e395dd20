"""A checkpoint of a small policy that has not been trained."""

import dataclasses
from pathlib import Path

import torch

from baselines.common.checkpoint import save_checkpoint
from baselines.common.encoders import EncoderConfig
from baselines.common.observation import observation_spec
from baselines.registry import policy_spec
from manifeel_ms3.nested_settings import as_json


def save_tiny_checkpoint(
    folder: Path,
    obs_mode: str = "tacff",
    cameras: tuple[str, ...] = (),
    crop: int = 0,
    diffusion_steps: int = 20,
    policy: str = "diffusion_policy",
) -> Path:
    """Write it, and return its folder; its camera images have 32 pixels, of which crops of `crop` pixels are taken."""
    spec = policy_spec(policy)
    paper = spec.presets["paper"].args
    tiny = dict(
        encoder=EncoderConfig(image="small_cnn", force_field="small", crop=crop),
        down_dims=(8, 16),
        diffusion_step_embed_dim=8,
        diffusion_steps=diffusion_steps,
        hidden=8,
        action_fields=8,
    )
    known = {field.name for field in dataclasses.fields(paper.policy)}
    config = dataclasses.replace(paper.policy, **{name: value for name, value in tiny.items() if name in known})
    observed = dict(obs_mode=obs_mode, cameras=list(cameras), tactile_sensors=["right"], image_size=32)
    observed |= dict(tactile_image_size=32, pose=paper.pose)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        untrained = spec.policy_class(config, observation_spec(obs_mode, cameras, ("right",), 32, pose=paper.pose), 6)
    about = dict(policy_name=policy, policy=as_json(config), action_dim=6, inference_steps=diffusion_steps, step=1) | observed
    save_checkpoint(folder, about, untrained.state_dict(), {})
    return folder
