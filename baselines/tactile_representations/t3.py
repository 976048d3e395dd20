"""T3-medium (Zhao et al. 2024, "Transferable Tactile Transformers for Representation Learning Across Diverse Sensors").

An encoder of its own for each sensor, three layers, and a trunk of nine that all sensors share: ViT-B, 86 M parameters.
"""

from pathlib import Path

import torch
import torch.nn as nn

from manifeel_ms3.evaluation.checkpoint_config import CheckpointError

from .representation import TokenRepresentation, imagenet_normalised, read_pickled
from .vit import EPS, Block, PatchEmbed, stretched

SENSOR = "gs_green"  # whose encoder the authors take for a sensor that has none
SIZE = 224  # pixels, that it was trained with


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
    patch = 16

    def __init__(self, width: int = 768, depth: tuple[int, int] = (3, 9), heads: int = 12):
        super().__init__()
        self.width = self.out_features = width
        self.encoder, self.trunk = _Encoder(width, depth[0], heads, self.patch), _Trunk(width, depth[1], heads)

    def embed(self, image):
        patches = self.encoder.patch_embed(imagenet_normalised(image))
        grid = [side // self.patch for side in image.shape[2:]]
        return patches + stretched(self.encoder.pos_embed[:, 1:], grid)

    def encode(self, tokens):
        first = (self.encoder.cls_token + self.encoder.pos_embed[:, :1]).expand(len(tokens), -1, -1)
        tokens = torch.cat([first, tokens], dim=1)
        for block in (*self.encoder.blocks, *self.trunk.blocks):
            tokens = block(tokens)
        return self.trunk.norm(tokens)[:, 1:]

    def read_published(self, path: Path):
        """The authors release a folder with encoders/<sensor>.pth and trunk.pth."""
        files = dict(encoder=path / f"encoders/{SENSOR}.pth", trunk=path / "trunk.pth")
        if missing := [str(file) for file in files.values() if not file.is_file()]:
            raise CheckpointError(f"{path} lacks {missing}; give the folder t3_medium that the authors released")
        return {f"{part}.{name}": t for part, file in files.items() for name, t in read_pickled(file).items()}

    def published(self, weights):
        return weights
