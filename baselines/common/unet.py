"""The 1-D U-Net over an action sequence of Diffusion Policy (Chi et al. 2023, section III-A), conditioned by FiLM."""

import math

import torch
import torch.nn as nn
import torch.nn.functional as F


class StepEmbedding(nn.Module):
    """Sinusoidal embedding (B, size) of a diffusion step (B,), through a small network."""

    def __init__(self, size: int):
        super().__init__()
        self.size = size
        self.net = nn.Sequential(nn.Linear(size, 4 * size), nn.Mish(), nn.Linear(4 * size, size))

    def forward(self, step: torch.Tensor) -> torch.Tensor:
        half = self.size // 2
        frequency = torch.exp(torch.arange(half, device=step.device) * (-math.log(10_000) / (half - 1)))
        angle = step.float()[:, None] * frequency
        return self.net(torch.cat([angle.sin(), angle.cos()], dim=-1))


class SequenceConv(nn.Conv1d):
    """A convolution over a short sequence, as one matrix product.

    Its weights are many times what they act on, which libraries' convolutions are not made for: with 2048 channels over four
    steps this takes less than half the time on a CPU (`benchmarks/train_speed.py`).
    """

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        windows = F.pad(x, 2 * self.padding).unfold(2, *self.kernel_size, *self.stride)  # (B, C, T, kernel)
        return F.linear(windows.movedim(1, 2).flatten(2), self.weight.flatten(1), self.bias).movedim(1, 2)


class ResidualBlock(nn.Module):
    """Two convolutions with a skip; the condition scales and shifts what lies between (FiLM)."""

    def __init__(self, inputs: int, outputs: int, condition: int, kernel: int, groups: int):
        super().__init__()
        self.first = _conv_block(inputs, outputs, kernel, groups)
        self.second = _conv_block(outputs, outputs, kernel, groups)
        self.film = nn.Sequential(nn.Mish(), nn.Linear(condition, 2 * outputs))
        self.skip = nn.Conv1d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, x: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        scale, shift = self.film(condition)[..., None].chunk(2, dim=1)
        return self.second(scale * self.first(x) + shift) + self.skip(x)


def _conv_block(inputs: int, outputs: int, kernel: int, groups: int) -> nn.Sequential:
    return nn.Sequential(SequenceConv(inputs, outputs, kernel, padding=kernel // 2), nn.GroupNorm(groups, outputs), nn.Mish())


class ConditionalUnet1D(nn.Module):
    """Predicts noise (B, T, A) in actions (B, T, A) at diffusion steps (B,), given conditions (B, C).

    Args:
        channels: widths from fine to coarse; T must be divisible by 2 ** (len(channels) - 1).
    """

    def __init__(
        self,
        action_dim: int,
        condition_dim: int,
        channels: tuple[int, ...] = (512, 1024, 2048),
        kernel: int = 5,
        groups: int = 8,
        step_embedding: int = 128,
    ):
        super().__init__()
        self.embed = StepEmbedding(step_embedding)
        shape = dict(condition=condition_dim + step_embedding, kernel=kernel, groups=groups)
        pairs = list(zip((action_dim, *channels[:-1]), channels, strict=True))
        self.down = nn.ModuleList(
            nn.ModuleList([ResidualBlock(i, o, **shape), ResidualBlock(o, o, **shape), SequenceConv(o, o, 3, 2, 1)])
            for i, o in pairs
        )
        self.down[-1][2] = nn.Identity()
        self.middle = nn.ModuleList(ResidualBlock(channels[-1], channels[-1], **shape) for _ in range(2))
        self.up = nn.ModuleList(
            nn.ModuleList([ResidualBlock(2 * o, i, **shape), ResidualBlock(i, i, **shape), nn.ConvTranspose1d(i, i, 4, 2, 1)])
            for i, o in reversed(pairs[1:])
        )
        self.out = nn.Sequential(_conv_block(channels[0], channels[0], kernel, groups), nn.Conv1d(channels[0], action_dim, 1))

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
