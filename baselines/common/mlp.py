"""A residual MLP over a whole action sequence, conditioned by FiLM: the network of the small policies for a CPU."""

import torch
import torch.nn as nn
import torch.nn.functional as F  # noqa: N812

from .unet import StepEmbedding


class FilmBlock(nn.Module):
    """Two layers with a skip connection; the condition scales and shifts the normalised features before them (FiLM)."""

    def __init__(self, width: int, condition_dim: int):
        super().__init__()
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.film = nn.Linear(condition_dim, 2 * width)
        self.first, self.second = nn.Linear(width, 2 * width), nn.Linear(2 * width, width)

    def forward(self, x: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        scale, shift = self.film(condition).chunk(2, dim=-1)
        return x + self.second(F.silu(self.first((1 + scale) * self.norm(x) + shift)))


class ConditionalMLP(nn.Module):
    """Predicts the noise (B, T, A) in actions (B, T, A) at diffusion steps (B,), given conditions (B, C).

    It consists of a few matrix products, which a CPU computes in less time than the convolutions of a U-Net.

    Args:
        action_dim: Number of components of an action, A.
        condition_dim: Number of features of a condition, C.
        pred_horizon: Number of actions, T.
        width: Number of features.
        blocks: Number of residual blocks.
        diffusion_step_embed_dim: Size of the embedding of the diffusion step.
    """

    def __init__(
        self, action_dim: int, condition_dim: int, pred_horizon: int, width: int, blocks: int, diffusion_step_embed_dim: int
    ):
        super().__init__()
        self.embed = StepEmbedding(diffusion_step_embed_dim)
        self.condition = nn.Sequential(nn.Linear(condition_dim + diffusion_step_embed_dim, width), nn.SiLU())
        self.enter = nn.Linear(pred_horizon * action_dim, width)
        self.blocks = nn.ModuleList(FilmBlock(width, width) for _ in range(blocks))
        self.leave = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, pred_horizon * action_dim))

    def forward(self, actions: torch.Tensor, step: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        condition = self.condition(torch.cat([self.embed(step), condition], dim=-1))
        x = self.enter(actions.flatten(1))
        for block in self.blocks:
            x = block(x, condition)
        return self.leave(x).view_as(actions)
