"""Equivariant Diffusion Policy (Wang et al. 2024): Diffusion Policy with networks that turn with the scene, by C8."""

from dataclasses import dataclass
from typing import Literal

import torch

from baselines.common.normalizer import Normalizer
from baselines.common.observation import POSE
from baselines.common.policy import module_name
from baselines.diffusion_policy.policy import DiffusionConfig, DiffusionPolicy

from .networks import ACTION_PAIRS, POSE_PAIRS, EquivariantObservationEncoder, EquivariantUnet


@dataclass
class EquivariantConfig(DiffusionConfig):
    """Defaults: the paper's."""

    prediction: Literal["epsilon", "sample"] = "sample"
    sampler: Literal["ddpm", "ddim"] = "ddim"
    hidden: int = 128
    """regular channels of the cameras' encoder at its end; each holds eight numbers"""


class EquivariantDiffusionPolicy(DiffusionPolicy):
    name = "equivariant_diffusion_policy"
    Config = EquivariantConfig
    config: EquivariantConfig

    def make_networks(self):
        config = self.config
        encoder = EquivariantObservationEncoder(config.encoder, self.spec, config.hidden, config.obs_horizon)
        shape = (config.channels, config.kernel, config.groups, config.step_embedding)
        return encoder, EquivariantUnet(self.action_dim, encoder.out_features, *shape)

    def fit_normalizers(self, observations, actions):
        super().fit_normalizers(observations, actions)
        pose = self.obs_normalizers[module_name(POSE)]
        position, *columns = POSE_PAIRS
        _alike(pose, position)
        for pair in columns:
            _alike(pose, pair, centred=True)
        for pair in ACTION_PAIRS[self.action_dim]:
            _alike(self.action_normalizer, pair, centred=True)


def _alike(normalizer: Normalizer, pair: tuple[int, int], centred: bool = False) -> None:
    """Scale both numbers of a vector alike, around the origin or around the middle of their ranges, so that it can turn."""
    low, high = normalizer.low[list(pair)], normalizer.high[list(pair)]
    centre = torch.zeros_like(low) if centred else (low + high) / 2
    half = torch.maximum(high - centre, centre - low).max()
    normalizer.low[list(pair)], normalizer.high[list(pair)] = centre - half, centre + half
