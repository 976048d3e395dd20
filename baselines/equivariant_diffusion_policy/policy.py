"""Equivariant Diffusion Policy (Wang et al. 2024): Diffusion Policy with networks that are equivariant under C8."""

from dataclasses import dataclass, field
from typing import Literal

import torch

from baselines.common.encoders import EncoderConfig
from baselines.common.normalizer import Normalizer
from baselines.common.observation import POSE
from baselines.common.policy import make_action_network
from baselines.diffusion_policy.policy import DiffusionConfig, DiffusionPolicy
from manifeel_ms3.agents.panda_gelsight import ACTION_AXES
from manifeel_ms3.arguments import require_at_least
from manifeel_ms3.errors import InvalidArgumentError

from .networks import ACTION_PAIRS, POSE_PAIRS, EquivariantActionNetwork, EquivariantObservationEncoder


@dataclass
class EquivariantConfig(DiffusionConfig):
    """Settings of the Equivariant Diffusion Policy; the defaults are those of the paper's public code."""

    prediction: Literal["epsilon", "sample"] = "sample"
    """What the network predicts: the noise, or the actions themselves."""
    sampler: Literal["ddpm", "ddim"] = "ddim"
    """Scheme of the generation."""
    encoder: EncoderConfig = field(
        default_factory=lambda: EncoderConfig(tacrgb="resnet18_keypoints", tactile_features=128, crop=230)
    )
    """Networks that encode the observations. Those of cameras are equivariant: "resnet18" or "small_cnn", with `hidden` regular
    fields instead of `image_features`."""
    hidden: int = 128
    """Number of regular fields of each camera's features and of an observation; each has eight numbers, one for every rotation
    of C8."""
    action_fields: int = 64
    """Number of regular fields that the network over action sequences has for an action."""

    def __post_init__(self):
        super().__post_init__()
        require_at_least(1, hidden=self.hidden, action_fields=self.action_fields)
        if self.encoder.image == "small_cnn" and self.hidden % 2:
            raise InvalidArgumentError(
                f"hidden={self.hidden} must be even with encoder.image='small_cnn': each key point has two fields"
            )
        if self.predicts_targets:
            raise InvalidArgumentError(
                "action_form='target': the orientation of a target does not turn with the scene as a vector does, which the "
                "networks of equivariant_diffusion_policy need; use 'delta'"
            )


class EquivariantDiffusionPolicy(DiffusionPolicy):
    """Equivariant Diffusion Policy (Wang et al. 2024): its actions turn with the scene about the vertical axis."""

    name = "equivariant_diffusion_policy"
    Config = EquivariantConfig
    control_modes = tuple(ACTION_AXES)
    config: EquivariantConfig  # pyright: ignore[reportIncompatibleVariableOverride] (set once, in the constructor)

    def make_networks(self):
        config = self.config
        encoder = EquivariantObservationEncoder(config.encoder, self.spec, config.hidden, config.obs_horizon)
        network = make_action_network(config, config.action_fields, encoder.out_features)
        return encoder, EquivariantActionNetwork(self.action_dim, config.action_fields, network)

    def action_pairs(self):
        return ACTION_PAIRS[self.action_dim]

    def fit_normalizers(self, observations, actions):
        super().fit_normalizers(observations, actions)
        pose = self.obs_normalizer(POSE)
        position, *columns = POSE_PAIRS
        _share_scale(pose, position)
        for pair in columns:
            _share_scale(pose, pair, centred=True)
        for pair in self.action_pairs():
            _share_scale(self.action_normalizer, pair, centred=True)


def _share_scale(normalizer: Normalizer, pair: tuple[int, int], centred: bool = False) -> None:
    """Scale the x and y of a vector by the same factor, so that the scaled vector turns as the vector does.

    Args:
        normalizer: Normaliser whose ranges are changed.
        pair: Indices of x and y.
        centred: Whether the ranges are centred on 0; else on the middle of the data's ranges.
    """
    low, high = normalizer.low[list(pair)], normalizer.high[list(pair)]
    centre = torch.zeros_like(low) if centred else (low + high) / 2
    half = torch.maximum(high - centre, centre - low).max()
    normalizer.low[list(pair)], normalizer.high[list(pair)] = centre - half, centre + half
