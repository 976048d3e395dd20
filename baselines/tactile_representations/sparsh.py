"""Sparsh (Higuera et al. 2024, "Self-supervised touch representations for vision-based tactile sensing"): ViT-B, by DINO.

Sparsh takes two images at once, the present one and an earlier one; here both are the present image, because a policy has its
own window of observations.
"""

import torch
import torch.nn as nn

from manifeel_ms3.evaluation.checkpoint_config import CheckpointError

from .representation import TokenRepresentation, sines_and_cosines
from .vit import EPS, Block, PatchEmbed

GRID = (20, 15)
"""Rows and columns of patches in the images that the published weights were trained on."""
LONGEST_WAVE = 1e4
"""Longest wavelength of the position embedding (Vaswani et al. 2017, section 3.5)."""
PREFIXES = ("teacher_encoder.backbone.", "target_encoder.backbone.")
"""Prefixes of the encoder's weights in the checkpoints trained by DINO and by I-JEPA."""


class _PositionEmbedding(nn.Module):
    frequency_bands: torch.Tensor

    def __init__(self, width: int):
        super().__init__()
        bands = LONGEST_WAVE ** -torch.linspace(0, 1, width // 4 + 1)[:-1]
        self.register_buffer("frequency_bands", bands.repeat(2, 1))

    def forward(self, grid: tuple[int, int]) -> torch.Tensor:
        """Embeddings (N, width) of a grid's patches, at positions scaled to the grid of the published weights."""
        axes = [torch.arange(n, device=self.frequency_bands.device) * (full / n) for n, full in zip(grid, GRID, strict=True)]
        return sines_and_cosines(torch.cartesian_prod(*axes), self.frequency_bands)


class Sparsh(TokenRepresentation):
    """Sparsh's vision transformer with one register token."""

    patch = 16

    def __init__(self, width: int = 768, depth: int = 12, heads: int = 12):
        super().__init__()
        self.width = self.out_features = width
        self.register_tokens = nn.Parameter(torch.zeros(1, 1, width))
        self.patch_embed, self.pos_embed = PatchEmbed(6, width, self.patch), _PositionEmbedding(width)
        self.blocks = nn.ModuleList(Block(width, heads, scaled=True) for _ in range(depth))
        self.norm = nn.LayerNorm(width, EPS)

    def embed(self, image):
        unit = (image + 1) / 2
        grid = (image.shape[2] // self.patch, image.shape[3] // self.patch)
        return self.patch_embed(torch.cat([unit, unit], dim=1)) + self.pos_embed(grid)

    def encode(self, tokens):
        tokens = torch.cat([self.register_tokens.expand(len(tokens), -1, -1), tokens], dim=1)
        for block in self.blocks:
            tokens = block(tokens)
        return self.norm(tokens)[:, 1:]

    def convert_state_dict(self, weights):
        for prefix in PREFIXES:
            if own := {name.removeprefix(prefix): t for name, t in weights.items() if name.startswith(prefix)}:
                return own
        raise CheckpointError(
            f"the checkpoint has no weights named {PREFIXES[0]}...; give dino_vitbase.ckpt of facebook/sparsh-dino-base"
        )
