"""Masked autoencoding (He et al. 2022): a transformer encodes some patches of an image, a decoder predicts the others."""

import torch
import torch.nn as nn
import torch.nn.functional as F  # noqa: N812

from .representation import TokenRepresentation
from .vit import EPS, POSITION_STD, Block

WIDTH, DEPTH, HEADS = 256, 2, 8
"""Number of features, of layers and of attention heads of the decoder, which only pretraining needs; smaller than that of He et
al. (2022), and not tuned."""
MASKED = 0.75
"""Share of the patches that is hidden, as in the paper."""
VARIANCE_EPS = 1e-4
"""Number that is added to the variance of a patch before the division by it, so that uniform patches stay small; set once, not
tuned."""


class MaskedAutoencoder(nn.Module):
    """The loss of a batch of TacRGB images (B, 3, size, size) in [-1, 1].

    Args:
        representation: The transformer that is trained.
        size: Side of the images, pixels.
    """

    mask_token: torch.Tensor

    def __init__(self, representation: TokenRepresentation, size: int):
        super().__init__()
        self.representation = representation
        patches = (size // representation.patch) ** 2
        self.narrow, self.mask_token = nn.Linear(representation.width, WIDTH), nn.Parameter(torch.zeros(1, 1, WIDTH))
        self.pos_embed = nn.Parameter(POSITION_STD * torch.randn(1, patches, WIDTH))
        self.decoder = nn.Sequential(*(Block(WIDTH, HEADS) for _ in range(DEPTH)), nn.LayerNorm(WIDTH, EPS))
        self.out = nn.Linear(WIDTH, 3 * representation.patch**2)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Mean squared error of the hidden patches, each normalised to mean 0 and standard deviation 1."""
        prepared = self.representation.prepare(image)
        tokens = self.representation.embed(prepared)
        order = torch.rand(tokens.shape[:2], device=image.device).argsort(1)
        kept = order[:, : round((1 - MASKED) * tokens.shape[1])]
        seen = self.representation.encode(_pick(tokens, kept))[:, self.representation.leading :]
        predicted = self._decoded(seen, kept, tokens.shape[1])
        patch = self.representation.patch
        patches = F.unfold(prepared, patch, stride=patch).transpose(1, 2)
        target = (patches - patches.mean(-1, keepdim=True)) / (patches.var(-1, keepdim=True) + VARIANCE_EPS).sqrt()
        hidden = order[:, kept.shape[1] :]
        return F.mse_loss(_pick(predicted, hidden), _pick(target, hidden))

    def _decoded(self, seen: torch.Tensor, kept: torch.Tensor, patches: int) -> torch.Tensor:
        filled = self.mask_token.to(seen.dtype).expand(len(seen), patches, -1)
        narrow = self.narrow(seen)
        filled = filled.scatter(1, kept[..., None].expand_as(narrow), narrow)
        return self.out(self.decoder(filled + self.pos_embed))


def _pick(tokens: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """The tokens (B, n, D) at indices (B, n)."""
    return tokens.gather(1, index[..., None].expand(-1, -1, tokens.shape[-1]))
