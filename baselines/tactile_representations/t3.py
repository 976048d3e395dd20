"""T3-medium (Zhao et al. 2024, "Transferable Tactile Transformers for Representation Learning Across Diverse Sensors").

Each sensor has its own encoder of three layers; all sensors share a trunk of nine. Both together are a ViT-B with 86 M
parameters. Images are normalised by the statistics of their own data set, as each of the authors' data sets is; the feature is
the class token, as in the paper's public code.
"""

from pathlib import Path

import torch
import torch.nn as nn

from manifeel_ms3.evaluation.checkpoint_config import CheckpointError

from .representation import ColourNormalisation, TokenRepresentation
from .vit import EPS, POSITION_STD, Block, PatchEmbed, interpolate_pos_embed

SENSORS = ("mini", "gs_green", "gs_black", "gs_tag", "gs_360_v2", "digit", "wedge", "finray")
"""Names of the released encoders; the paper's public code takes that of the GelSight Mini."""
TRUNK_EPS = 1e-5
"""Epsilon of the trunk's layer norms: torch's default, whereas the encoders have timm's."""


class _Encoder(nn.Module):
    def __init__(self, width: int, depth: int, heads: int, patch: int, size: int):
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(POSITION_STD * torch.randn(1, (size // patch) ** 2 + 1, width))
        self.patch_embed = PatchEmbed(3, width, patch)
        self.blocks = nn.ModuleList(Block(width, heads, EPS) for _ in range(depth))


class _Trunk(nn.Module):
    def __init__(self, width: int, depth: int, heads: int):
        super().__init__()
        self.blocks = nn.ModuleList(Block(width, heads, TRUNK_EPS) for _ in range(depth))
        self.norm = nn.LayerNorm(width, TRUNK_EPS)


class T3(TokenRepresentation):
    """T3 with the encoder of one sensor.

    Args:
        width: Number of features of a token.
        depth: Number of layers of the encoder and of the trunk.
        heads: Number of attention heads.
    """

    patch, size, leading = 16, 224, 1
    released = "the folder t3_medium with encoders/<sensor>.pth and trunk.pth"
    sensors, sensor = SENSORS, SENSORS[0]

    def __init__(self, width: int = 768, depth: tuple[int, int] = (3, 9), heads: int = 12):
        super().__init__()
        self.width = self.out_features = width
        self.encoder = _Encoder(width, depth[0], heads, self.patch, self.size)
        self.trunk = _Trunk(width, depth[1], heads)
        self.normalisation = ColourNormalisation()

    def fit(self, images):
        self.normalisation.fit(images)

    def prepare(self, image):
        return self.normalisation(image)

    def embed(self, prepared):
        grid = [side // self.patch for side in prepared.shape[2:]]
        return self.encoder.patch_embed(prepared) + interpolate_pos_embed(self.encoder.pos_embed[:, 1:], grid)

    def encode(self, tokens):
        first = (self.encoder.cls_token + self.encoder.pos_embed[:, :1]).expand(len(tokens), -1, -1)
        tokens = torch.cat([first, tokens], dim=1)
        for block in (*self.encoder.blocks, *self.trunk.blocks):
            tokens = block(tokens)
        return self.trunk.norm(tokens)

    def pool(self, tokens):
        return tokens[:, 0]

    def read(self, path: Path):
        """The weights of the released folder, or of a file that `pretrain.py` wrote."""
        if path.is_file():
            return super().read(path)
        parts = {part: _weights_file(path, stem) for part, stem in (("encoder", f"encoders/{self.sensor}"), ("trunk", "trunk"))}
        return {f"{part}.{name}": t for part, file in parts.items() for name, t in super(T3, self).read(file).items()}

    def convert_state_dict(self, weights):
        return weights


def _weights_file(folder: Path, stem: str) -> Path:
    """The file of this stem in the released folder, as the authors saved it or as safetensors.

    Raises:
        CheckpointError: The folder lacks the file.
    """
    for suffix in (".pth", ".safetensors"):
        if (folder / f"{stem}{suffix}").is_file():
            return folder / f"{stem}{suffix}"
    raise CheckpointError(f"{folder} lacks {stem}.pth; give {T3.released}")
