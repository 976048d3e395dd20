"""T3-medium (Zhao et al. 2024, "Transferable Tactile Transformers for Representation Learning Across Diverse Sensors").

Each sensor has its own encoder of three layers; all sensors share a trunk of nine. Both together are a ViT-B with 86 M
parameters.
"""

from pathlib import Path

import torch
import torch.nn as nn

from manifeel_ms3.evaluation.checkpoint_config import CheckpointError

from .released_weights import read_released
from .representation import TokenRepresentation, imagenet_normalised
from .vit import EPS, Block, PatchEmbed, interpolate_pos_embed

SENSOR = "gs_green"
"""Name of the released encoder that the authors use for a sensor without an encoder of its own."""
SIZE = 224
"""Side of the images that the published weights were trained on, pixels."""


class _Encoder(nn.Module):
    def __init__(self, width: int, depth: int, heads: int, patch: int):
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(0.02 * torch.randn(1, (SIZE // patch) ** 2 + 1, width))
        self.patch_embed = PatchEmbed(3, width, patch)
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(depth))


class _Trunk(nn.Module):
    def __init__(self, width: int, depth: int, heads: int):
        super().__init__()
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(width, EPS)


class T3(TokenRepresentation):
    """T3 with the encoder of one sensor.

    Args:
        width: Number of features of a token.
        depth: Number of layers of the encoder and of the trunk.
        heads: Number of attention heads.
    """

    patch = 16

    def __init__(self, width: int = 768, depth: tuple[int, int] = (3, 9), heads: int = 12):
        super().__init__()
        self.width = self.out_features = width
        self.encoder, self.trunk = _Encoder(width, depth[0], heads, self.patch), _Trunk(width, depth[1], heads)

    def embed(self, image):
        patches = self.encoder.patch_embed(imagenet_normalised(image))
        grid = [side // self.patch for side in image.shape[2:]]
        return patches + interpolate_pos_embed(self.encoder.pos_embed[:, 1:], grid)

    def encode(self, tokens):
        first = (self.encoder.cls_token + self.encoder.pos_embed[:, :1]).expand(len(tokens), -1, -1)
        tokens = torch.cat([first, tokens], dim=1)
        for block in (*self.encoder.blocks, *self.trunk.blocks):
            tokens = block(tokens)
        return self.trunk.norm(tokens)[:, 1:]

    def read_released(self, path: Path):
        """The weights of the released folder, which holds encoders/<sensor>.pth and trunk.pth."""
        files = dict(encoder=path / f"encoders/{SENSOR}.pth", trunk=path / "trunk.pth")
        if missing := [str(file) for file in files.values() if not file.is_file()]:
            raise CheckpointError(f"{path} lacks {missing}; give the folder t3_medium that the authors released")
        return {f"{part}.{name}": t for part, file in files.items() for name, t in read_released(file).items()}

    def convert_state_dict(self, weights):
        return weights
