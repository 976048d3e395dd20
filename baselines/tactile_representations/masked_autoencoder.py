"""Masked autoencoding (He et al. 2022): a transformer sees a part of a picture's patches and tells the others."""

import torch
import torch.nn as nn
import torch.nn.functional as F

from .representation import TokenRepresentation
from .vit import EPS, Block

WIDTH, DEPTH, HEADS = 256, 2, 8  # of the decoder, which is thrown away


class MaskedAutoencoder(nn.Module):
    """The loss of a batch of TacRGB pictures (B, 3, H, W) in [-1, 1], of `size` pixels a side; `masked`: share of patches."""

    def __init__(self, representation: TokenRepresentation, size: int, masked: float = 0.75):
        super().__init__()
        self.representation, self.masked = representation, masked
        self.patch, patches = representation.patch, (size // representation.patch) ** 2
        self.narrow, self.mask_token = nn.Linear(representation.width, WIDTH), nn.Parameter(torch.zeros(1, 1, WIDTH))
        self.places = nn.Parameter(0.02 * torch.randn(1, patches, WIDTH))
        self.decoder = nn.Sequential(*(Block(WIDTH, HEADS) for _ in range(DEPTH)), nn.LayerNorm(WIDTH, EPS))
        self.out = nn.Linear(WIDTH, 3 * self.patch**2)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Mean squared error of the hidden patches, each brought to mean 0 and deviation 1."""
        tokens = self.representation.embed(image)
        order = torch.rand(tokens.shape[:2], device=image.device).argsort(1)
        kept = order[:, : round((1 - self.masked) * tokens.shape[1])]
        told = self._decoded(self.representation.encode(_pick(tokens, kept)), kept, tokens.shape[1])
        patches = F.unfold(image, self.patch, stride=self.patch).transpose(1, 2)
        wanted = (patches - patches.mean(-1, keepdim=True)) / (patches.var(-1, keepdim=True) + 1e-4).sqrt()
        hidden = order[:, kept.shape[1] :]
        return F.mse_loss(_pick(told, hidden), _pick(wanted, hidden))

    def _decoded(self, seen: torch.Tensor, kept: torch.Tensor, patches: torch.Tensor) -> torch.Tensor:
        filled = self.mask_token.to(seen.dtype).expand(len(seen), patches, -1)
        narrow = self.narrow(seen)
        filled = filled.scatter(1, kept[..., None].expand_as(narrow), narrow)
        return self.out(self.decoder(filled + self.places))


def _pick(tokens: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Tokens (B, n, D) at indices (B, n)."""
    return tokens.gather(1, index[..., None].expand(-1, -1, tokens.shape[-1]))
