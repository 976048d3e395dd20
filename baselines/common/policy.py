"""What every policy shares: an observation encoder, normalisers, and how a prediction becomes actions."""

from dataclasses import dataclass, field
from typing import ClassVar

import torch
import torch.nn as nn

from .encoders import EncoderConfig, ObservationEncoder
from .normalizer import Normalizer
from .observation import POSE, POSE_FEATURES, ObservationSpec
from .unet import ConditionalUnet1D


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
    pose_noise: float = 0.0
    """standard deviation added to the normalised tool pose in training: a few demonstrations are else told apart by it alone"""
    noise_draws: int = 1
    """noises per observation in a loss; more is cheap where the encoder is the cost"""


class VisuotactilePolicy(nn.Module):
    """Generates an action sequence, conditioned on a window of observations.

    Subclasses define `generation_loss` and `generate`, and may make other networks of their own.
    """

    name: ClassVar[str]
    """Name under which the policy is registered (`baselines.registry`)."""
    Config = PolicyConfig

    def __init__(self, config: PolicyConfig, spec: ObservationSpec, action_dim: int):
        super().__init__()
        self.config, self.spec, self.action_dim = config, spec, action_dim
        self.encoder, self.unet = self.make_networks()
        sizes = {POSE: POSE_FEATURES} | dict.fromkeys(spec.force_fields, 3)
        self.obs_normalizers = nn.ModuleDict({module_name(key): Normalizer(size) for key, size in sizes.items()})
        self.action_normalizer = Normalizer(action_dim)

    def make_networks(self) -> tuple[nn.Module, nn.Module]:
        """The encoder of observations, and the network over action sequences."""
        config = self.config
        encoder = ObservationEncoder(config.encoder, self.spec, config.obs_horizon)
        shape = (config.channels, config.kernel, config.groups, config.step_embedding)
        return encoder, ConditionalUnet1D(self.action_dim, encoder.out_features, *shape)

    def generation_loss(self, clean: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        """A scalar, for normalised actions (B, pred_horizon, A) under conditions (B, ...)."""
        raise NotImplementedError

    def generate(self, condition: torch.Tensor, steps: int, generator: torch.Generator) -> torch.Tensor:
        """Normalised actions (B, pred_horizon, A), in so many steps."""
        raise NotImplementedError

    def fit_normalizers(self, observations: dict[str, torch.Tensor], actions: torch.Tensor) -> None:
        """Take the ranges of observations {key: (S, ...)} and actions (S, A) from the demonstrations."""
        for key in (POSE, *self.spec.force_fields):
            self.obs_normalizers[module_name(key)].fit(observations[key])
        self.action_normalizer.fit(actions)

    def condition(self, obs: dict[str, torch.Tensor], pose_noise: float = 0.0) -> torch.Tensor:
        """Features (B, ...) of observations {key: (B, obs_horizon, ...)}."""
        normalised = {
            key: self.obs_normalizers[module_name(key)].normalize(obs[key]) for key in (POSE, *self.spec.force_fields)
        }
        if pose_noise > 0:
            normalised[POSE] = normalised[POSE] + pose_noise * torch.randn_like(normalised[POSE])
        return self.encoder({**obs, **normalised})

    def forward(self, obs: dict[str, torch.Tensor], actions: torch.Tensor) -> torch.Tensor:
        """The loss of a batch; actions (B, pred_horizon, A)."""
        draws = self.config.noise_draws
        condition = self.condition(obs, self.config.pose_noise).repeat_interleave(draws, dim=0)
        return self.generation_loss(self.action_normalizer.normalize(actions).repeat_interleave(draws, dim=0), condition)

    @torch.no_grad()
    def sample(self, obs: dict[str, torch.Tensor], inference_steps: int, generator: torch.Generator) -> torch.Tensor:
        """Actions (B, action_horizon, A) to carry out next."""
        actions = self.generate(self.condition(obs), inference_steps, generator)
        first = self.config.obs_horizon - 1
        return self.action_normalizer.restore(actions)[:, first : first + self.config.action_horizon]

    def noise(self, condition: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """What generation begins with, (B, pred_horizon, A)."""
        shape = (len(condition), self.config.pred_horizon, self.action_dim)
        return torch.randn(shape, generator=generator, device=condition.device)


def module_name(key: str) -> str:
    """Module names must not hold dots; slashes become underscores for looks."""
    return key.replace("/", "_")
