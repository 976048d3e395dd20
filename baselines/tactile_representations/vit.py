"""A vision transformer with timm's weight names, which the published checkpoints of tactile representations have.

timm itself needs torchvision, which cannot be installed beside the CPU build of torch, and transformers' ViT has other weight
names and no layer scale.
"""

import torch
import torch.nn as nn
import torch.nn.functional as F  # noqa: N812

EPS = 1e-6
"""Epsilon of the layer norms, as in timm."""
POSITION_STD = 0.02
"""Standard deviation of position embeddings before training, as in timm."""


class Attention(nn.Module):
    """Multi-head self-attention over tokens (B, N, width)."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        q, k, v = self.qkv(tokens).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        return self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class Mlp(nn.Module):
    """The two-layer network of a transformer block, four times as wide inside."""

    def __init__(self, width: int):
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        return self.fc2(F.gelu(self.fc1(tokens)))


class LayerScale(nn.Module):
    """Learned factors of each feature (Touvron et al. 2021)."""

    def __init__(self, width: int):
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        return self.gamma * tokens


class Block(nn.Module):
    """A transformer block (B, N, width) -> (B, N, width), with layer norms of this epsilon and layer scale if `scaled`."""

    def __init__(self, width: int, heads: int, eps: float = EPS, scaled: bool = False):
        super().__init__()
        self.norm1, self.attn = nn.LayerNorm(width, eps), Attention(width, heads)
        self.norm2, self.mlp = nn.LayerNorm(width, eps), Mlp(width)
        self.ls1, self.ls2 = (LayerScale(width) if scaled else nn.Identity() for _ in range(2))

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        tokens = tokens + self.ls1(self.attn(self.norm1(tokens)))
        return tokens + self.ls2(self.mlp(self.norm2(tokens)))


class PatchEmbed(nn.Module):
    """Embeddings (B, N, width) of the patches of images (B, C, H, W), row by row."""

    def __init__(self, channels: int, width: int, patch: int):
        super().__init__()
        self.proj = nn.Conv2d(channels, width, patch, patch)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.proj(image).flatten(2).transpose(1, 2)


def interpolate_pos_embed(learned: torch.Tensor, grid: list[int]) -> torch.Tensor:
    """Position embeddings (1, N, width) that were learned on a square grid, interpolated for another grid of patches."""
    side = round(learned.shape[1] ** 0.5)
    if grid == [side, side]:
        return learned
    square = learned.transpose(1, 2).unflatten(2, (side, side))
    return F.interpolate(square, grid, mode="bicubic").flatten(2).transpose(1, 2)
