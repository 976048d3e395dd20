"""Sparsh (Higuera et al. 2024, "Self-supervised touch representations for vision-based tactile sensing"): ViT-B, by DINO.

Sparsh sees how an image differs from that of the untouched sensor, upright. It takes two images at once, the present one and an
earlier one; here both are the present image, because a policy has its own window of observations.
"""

from pathlib import Path

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F  # noqa: N812

from manifeel_ms3.sensors.config import TactileSensorConfig
from manifeel_ms3.sensors.optics.shader import Shader, place_terms

from .representation import TokenRepresentation, under_prefix
from .vit import EPS, Block, PatchEmbed

LONGEST_WAVE = 1e4
"""Longest wavelength of the position embedding (Vaswani et al. 2017, section 3.5)."""
PREFIXES = ("teacher_encoder.backbone.", "target_encoder.backbone.")
"""Prefixes of the encoder's weights in the checkpoints trained by DINO and by I-JEPA; the safetensors files have none."""
UPRIGHT = (320, 240)
"""Rows and columns of the images that the published weights were trained on."""
OFFSET = 0.5
"""Brightness, as a share of the range, of a place at which an image does not differ from the untouched sensor's."""


class _PositionEmbedding(nn.Module):
    frequency_bands: torch.Tensor

    def __init__(self, width: int):
        super().__init__()
        bands = LONGEST_WAVE ** -torch.linspace(0, 1, width // 4 + 1)[:-1]
        self.register_buffer("frequency_bands", bands.repeat(2, 1))

    def forward(self, grid: tuple[int, int]) -> torch.Tensor:
        """Embeddings (N, width) of a grid's patches: for the row, then for the column, the sines, then the cosines.

        Rows and columns are counted from 0 in a grid of any size, as in networks that the authors build for other image sizes.
        """
        axes = [torch.arange(float(n), device=self.frequency_bands.device) for n in grid]
        phase = torch.cartesian_prod(*axes)[..., None] * self.frequency_bands
        return torch.cat([phase.sin(), phase.cos()], dim=-1).flatten(1)


class Sparsh(TokenRepresentation):
    """Sparsh's vision transformer with one register token; its feature is the mean of the patch tokens."""

    patch, size, leading = 16, 224, 1
    released = "dino_vitbase.safetensors (or dino_vitbase.ckpt) of facebook/sparsh-dino-base"
    untouched: torch.Tensor

    def __init__(self, width: int = 768, depth: int = 12, heads: int = 12):
        super().__init__()
        self.width = self.out_features = width
        self.register_tokens = nn.Parameter(torch.zeros(1, 1, width))
        self.patch_embed, self.pos_embed = PatchEmbed(6, width, self.patch), _PositionEmbedding(width)
        self.blocks = nn.ModuleList(Block(width, heads, EPS, scaled=True) for _ in range(depth))
        self.norm = nn.LayerNorm(width, EPS)
        flat = torch.as_tensor(untouched_image(), dtype=torch.float32).movedim(-1, 0)[None]
        self.register_buffer("untouched", upright(flat), persistent=False)

    def prepare(self, image):
        """The difference from the untouched sensor, upright, in [0, 1] and in whole grey levels, as the authors store it.

        The untouched image is that of the default sensor, so that images of other sensors differ from it everywhere.
        """
        levels = upright((image + 1) * 127.5)
        untouched = F.interpolate(self.untouched, levels.shape[2:], mode="bilinear", antialias=True).round()
        return (levels - untouched + 255 * OFFSET).clamp(0, 255).floor() / 255

    def embed(self, prepared):
        grid = (prepared.shape[2] // self.patch, prepared.shape[3] // self.patch)
        return self.patch_embed(torch.cat([prepared, prepared], dim=1)) + self.pos_embed(grid)

    def encode(self, tokens):
        tokens = torch.cat([self.register_tokens.expand(len(tokens), -1, -1), tokens], dim=1)
        for block in self.blocks:
            tokens = block(tokens)
        return self.norm(tokens)

    def pool(self, tokens):
        return tokens[:, self.leading :].mean(1)

    def convert_state_dict(self, weights):
        return next((own for prefix in PREFIXES if (own := under_prefix(weights, prefix))), weights)


def upright(image: torch.Tensor) -> torch.Tensor:
    """Images (B, C, H, W) in the form in which the authors give them to the network.

    Images that lie on their side are turned clockwise; those that are not 4 to 3 then lose rows above and below, as in the
    authors' code, and come to 320 x 240. A square image is a sensor's image that was resized, and is only turned.
    """
    if image.shape[2] <= image.shape[3]:
        image = image.rot90(-1, (2, 3))
    rows, columns = image.shape[2:]
    if rows == columns:
        return image
    if 3 * rows != 4 * columns:
        kept = int(rows * 3 / 4)
        image = image[:, :, (rows - kept) // 2 : (rows + kept) // 2]
    return F.interpolate(image, UPRIGHT, mode="bilinear", antialias=True) if image.shape[2:] != UPRIGHT else image


def untouched_image() -> np.ndarray:
    """TacRGB uint8 (240, 320, 3) of the default sensor while nothing touches it."""
    config = TactileSensorConfig()
    rows, columns = (np.linspace(-1, 1, n) for n in config.image_shape)
    place = place_terms(*np.meshgrid(rows, columns, indexing="ij"))
    background = Shader.load(Path(config.optics.calibration)).background
    return ((place @ background.T).astype(np.float32) + 0.5).clip(0, 255).astype(np.uint8)
