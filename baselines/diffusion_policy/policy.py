"""Diffusion Policy (Chi et al. 2023, "Diffusion Policy: Visuomotor Policy Learning via Action Diffusion"), CNN version."""

from dataclasses import dataclass, field
from typing import Literal

import torch
import torch.nn as nn
import torch.nn.functional as F
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

from baselines.common.encoders import EncoderConfig, ObservationEncoder
from baselines.common.normalizer import Normalizer
from baselines.common.observation import POSE, ObservationSpec
from baselines.common.unet import ConditionalUnet1D


@dataclass
class PolicyConfig:
    """Defaults: the paper's."""

    obs_horizon: int = 2
    pred_horizon: int = 16
    action_horizon: int = 8
    """actions of a prediction that are carried out before the next"""
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    channels: tuple[int, ...] = (512, 1024, 2048)
    kernel: int = 5
    groups: int = 8
    step_embedding: int = 128
    diffusion_steps: int = 100
    prediction: Literal["epsilon", "sample"] = "epsilon"
    """what the network predicts: the noise (the paper's), or the clean actions, which short trainings learn far sooner"""
    pose_noise: float = 0.0
    """standard deviation added to the normalised tool pose in training: a few demonstrations are else told apart by it alone"""
    noise_draws: int = 1
    """noises per observation in a loss; more is cheap where the encoder is the cost"""


class DiffusionPolicy(nn.Module):
    """Denoises an action sequence, conditioned on a window of observations."""

    def __init__(self, config: PolicyConfig, spec: ObservationSpec, action_dim: int):
        super().__init__()
        self.config, self.spec, self.action_dim = config, spec, action_dim
        self.encoder = ObservationEncoder(config.encoder, spec, config.obs_horizon)
        self.unet = ConditionalUnet1D(
            action_dim, self.encoder.out_features, config.channels, config.kernel, config.groups, config.step_embedding
        )
        sizes = {POSE: 9} | dict.fromkeys(spec.force_fields, 3)
        self.obs_normalizers = nn.ModuleDict({_name(key): Normalizer(size) for key, size in sizes.items()})
        self.action_normalizer = Normalizer(action_dim)
        schedule = dict(
            num_train_timesteps=config.diffusion_steps,
            beta_schedule="squaredcos_cap_v2",
            prediction_type=config.prediction,
            clip_sample=True,
        )
        self.ddpm, self.ddim = DDPMScheduler(**schedule), DDIMScheduler(**schedule)

    def fit_normalizers(self, observations: dict[str, torch.Tensor], actions: torch.Tensor) -> None:
        """Take the ranges of observations {key: (S, ...)} and actions (S, A) from the demonstrations."""
        for key in (POSE, *self.spec.force_fields):
            self.obs_normalizers[_name(key)].fit(observations[key])
        self.action_normalizer.fit(actions)

    def condition(self, obs: dict[str, torch.Tensor], pose_noise: float = 0.0) -> torch.Tensor:
        """Features (B, C) of observations {key: (B, obs_horizon, ...)}."""
        normalised = {key: self.obs_normalizers[_name(key)].normalize(obs[key]) for key in (POSE, *self.spec.force_fields)}
        if pose_noise > 0:
            normalised[POSE] = normalised[POSE] + pose_noise * torch.randn_like(normalised[POSE])
        return self.encoder({**obs, **normalised})

    def loss(self, obs: dict[str, torch.Tensor], actions: torch.Tensor) -> torch.Tensor:
        """Mean squared error of the predicted noise, or clean actions; actions (B, pred_horizon, A)."""
        draws = self.config.noise_draws
        condition = self.condition(obs, self.config.pose_noise).repeat_interleave(draws, dim=0)
        clean = self.action_normalizer.normalize(actions).repeat_interleave(draws, dim=0)
        noise = torch.randn_like(clean)
        step = torch.randint(self.config.diffusion_steps, (len(clean),), device=clean.device)
        noisy = self.ddpm.add_noise(clean, noise, step)
        return F.mse_loss(self.unet(noisy, step, condition), noise if self.config.prediction == "epsilon" else clean)

    @torch.no_grad()
    def sample(self, obs: dict[str, torch.Tensor], inference_steps: int, generator: torch.Generator) -> torch.Tensor:
        """Actions (B, action_horizon, A) to carry out next: DDPM with all steps, DDIM with fewer."""
        condition = self.condition(obs)
        shape = (len(condition), self.config.pred_horizon, self.action_dim)
        actions = torch.randn(shape, generator=generator, device=condition.device)
        full = inference_steps >= self.config.diffusion_steps
        scheduler = self.ddpm if full else self.ddim
        scheduler.set_timesteps(min(inference_steps, self.config.diffusion_steps), device=condition.device)
        for step in scheduler.timesteps:
            predicted = self.unet(actions, step.expand(len(actions)), condition)
            extra = dict(generator=generator) if full else {}
            actions = scheduler.step(predicted, step, actions, **extra).prev_sample
        first = self.config.obs_horizon - 1
        return self.action_normalizer.restore(actions)[:, first : first + self.config.action_horizon]


def _name(key: str) -> str:
    """Module names must not hold dots; slashes become underscores for looks."""
    return key.replace("/", "_")
