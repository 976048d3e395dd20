"""The 1-D U-Net over an action sequence of Diffusion Policy (Chi et al. 2023, section III-A), conditioned by FiLM."""

import math
from functools import partial

import torch
import torch.nn as nn
import torch.nn.functional as F  # noqa: N812

DOWN_DIMS, KERNEL_SIZE, NUM_GROUPS, STEP_EMBED_DIM = (512, 1024, 2048), 5, 8, 128
"""Channels at each scale, kernel size, number of groups of GroupNorm, and size of the embedding of the diffusion step, as in
the public code of Diffusion Policy."""
LONGEST_WAVE = 10_000
"""Longest wavelength of the step embedding (Vaswani et al. 2017, section 3.5)."""


class StepEmbedding(nn.Module):
    """Sinusoidal embedding (B, size) of a diffusion step (B,), followed by a small network."""

    def __init__(self, size: int):
        super().__init__()
        self.size = size
        self.net = nn.Sequential(nn.Linear(size, 4 * size), nn.Mish(), nn.Linear(4 * size, size))

    def forward(self, step: torch.Tensor) -> torch.Tensor:
        half = self.size // 2
        frequency = torch.exp(torch.arange(half, device=step.device) * (-math.log(LONGEST_WAVE) / (half - 1)))
        angle = step.float()[:, None] * frequency
        return self.net(torch.cat([angle.sin(), angle.cos()], dim=-1))


class SequenceConv(nn.Conv1d):
    """A convolution over a short sequence, computed as one matrix product.

    Its weights are many times larger than its input, a case for which library convolutions are not made: with 2048 channels
    over four steps the product takes less than half the time on a CPU (`benchmarks/train_speed.py`).
    """

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        padded = F.pad(x, 2 * self.padding)  # pyright: ignore[reportArgumentType] (padding is never a string here)
        windows = padded.unfold(2, *self.kernel_size, *self.stride)  # (B, C, T, kernel_size)
        return F.linear(windows.movedim(1, 2).flatten(2), self.weight.flatten(1), self.bias).movedim(1, 2)


class ResidualBlock(nn.Module):
    """Two convolutions with a skip connection; the condition scales and shifts the features between them (FiLM)."""

    def __init__(self, inputs: int, outputs: int, condition_dim: int, kernel_size: int, n_groups: int):
        super().__init__()
        self.first = _conv_block(inputs, outputs, kernel_size, n_groups)
        self.second = _conv_block(outputs, outputs, kernel_size, n_groups)
        self.film = nn.Sequential(nn.Mish(), nn.Linear(condition_dim, 2 * outputs))
        self.skip = nn.Conv1d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, x: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        scale, shift = self.film(condition)[..., None].chunk(2, dim=1)
        return self.second(scale * self.first(x) + shift) + self.skip(x)


def _conv_block(inputs: int, outputs: int, kernel_size: int, n_groups: int) -> nn.Sequential:
    conv = SequenceConv(inputs, outputs, kernel_size, padding=kernel_size // 2)
    return nn.Sequential(conv, nn.GroupNorm(n_groups, outputs), nn.Mish())


class ConditionalUnet1D(nn.Module):
    """Predicts the noise (B, T, A) in actions (B, T, A) at diffusion steps (B,), given conditions (B, C).

    The defaults, and the kernels and strides between the scales, are those of Diffusion Policy.

    Args:
        action_dim: Number of components of an action, A.
        condition_dim: Number of features of a condition, C.
        down_dims: Channels from the finest to the coarsest scale; T must be divisible by 2 ** (len(down_dims) - 1).
        kernel_size: Kernel size of the convolutions.
        n_groups: Number of groups of GroupNorm.
        diffusion_step_embed_dim: Size of the embedding of the diffusion step.
    """

    def __init__(
        self,
        action_dim: int,
        condition_dim: int,
        down_dims: tuple[int, ...] = DOWN_DIMS,
        kernel_size: int = KERNEL_SIZE,
        n_groups: int = NUM_GROUPS,
        diffusion_step_embed_dim: int = STEP_EMBED_DIM,
    ):
        super().__init__()
        self.embed = StepEmbedding(diffusion_step_embed_dim)
        block = partial(
            ResidualBlock,
            condition_dim=condition_dim + diffusion_step_embed_dim,
            kernel_size=kernel_size,
            n_groups=n_groups,
        )
        pairs = list(zip((action_dim, *down_dims[:-1]), down_dims, strict=True))
        self.down = nn.ModuleList(nn.ModuleList([block(i, o), block(o, o), SequenceConv(o, o, 3, 2, 1)]) for i, o in pairs)
        self.down[-1][2] = nn.Identity()  # pyright: ignore[reportIndexIssue]
        self.middle = nn.ModuleList(block(down_dims[-1], down_dims[-1]) for _ in range(2))
        self.up = nn.ModuleList(
            nn.ModuleList([block(2 * o, i), block(i, i), nn.ConvTranspose1d(i, i, 4, 2, 1)]) for i, o in reversed(pairs[1:])
        )
        self.out = nn.Sequential(
            _conv_block(down_dims[0], down_dims[0], kernel_size, n_groups), nn.Conv1d(down_dims[0], action_dim, 1)
        )

    def forward(self, actions: torch.Tensor, step: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        condition = torch.cat([self.embed(step), condition], dim=-1)
        x, skips = actions.movedim(1, 2), []
        for block in self.down:
            first, second, shrink = block.children()
            x = second(first(x, condition), condition)
            skips.append(x)
            x = shrink(x)
        for residual in self.middle:
            x = residual(x, condition)
        for block in self.up:
            first, second, grow = block.children()
            x = grow(second(first(torch.cat([x, skips.pop()], dim=1), condition), condition))
        return self.out(x).movedim(1, 2)
