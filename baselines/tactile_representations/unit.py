"""UniT (Xu et al. 2025, "Data Efficient Tactile Representation with Generalization to Unseen Objects"): a VQGAN's encoder.

Trained by `pretrain.py` on TacRGB of a few simple objects; a policy takes what the encoder says before it is quantised.
"""

import re
from pathlib import Path

import torch
import torch.nn as nn
from diffusers import VQModel

from manifeel_ms3.evaluation.checkpoint_config import CheckpointError

from .representation import Representation

LATENT_CHANNELS, CODES = 3, 1024
CHANNELS = (128, 128, 256, 512)
IN_ATTENTION = {"norm": "group_norm", "q": "to_q", "k": "to_k", "v": "to_v", "proj_out": "to_out.0"}


class UniT(Representation):
    """`attention`: also at the coarsest scale, as in the weights that its authors released (trained at 128 x 160)."""

    patch = 8

    def __init__(self, channels: tuple[int, ...] = CHANNELS, attention: bool = False, out_features: int = 512):
        super().__init__()
        coarsest = "Attn" if attention else ""
        finer = len(channels) - 1
        self.vqgan = VQModel(
            down_block_types=("DownEncoderBlock2D",) * finer + (f"{coarsest}DownEncoderBlock2D",),
            up_block_types=(f"{coarsest}UpDecoderBlock2D",) + ("UpDecoderBlock2D",) * finer,
            block_out_channels=channels,
            layers_per_block=2,
            latent_channels=LATENT_CHANNELS,
            num_vq_embeddings=CODES,
        )
        self.head = nn.Sequential(
            *_block(LATENT_CHANNELS, 128),
            nn.MaxPool2d(2),
            *_block(128, 256),
            nn.MaxPool2d(2),
            *_block(256, 512),
            nn.AdaptiveMaxPool2d(2),
        )
        self.out = nn.Linear(4 * 512, out_features)
        self.out_features = out_features

    def forward(self, image):
        return self.out(self.head(self.vqgan.encode(image).latents).flatten(1))

    @property
    def saved(self) -> Representation:
        """What is kept of it for other policies: the VQGAN; the head is a policy's own."""
        return _Vqgan(self.vqgan)

    def load(self, path: Path) -> None:
        self.saved.load(path)


class _Vqgan(Representation):
    def __init__(self, vqgan: VQModel):
        super().__init__()
        self.vqgan = vqgan

    def published(self, weights):
        if has_attention(weights) and not has_attention(self.state_dict()):
            raise CheckpointError(
                "these weights have attention at the coarsest scale; give --policy.encoder.tacrgb unit_released"
            )
        return {f"vqgan.{n}": t for n, t in from_taming(weights, len(self.vqgan.config["block_out_channels"])).items()}


def _block(inputs: int, outputs: int) -> list[nn.Module]:
    return [nn.Conv2d(inputs, outputs, 3, padding=1), nn.GroupNorm(4, outputs), nn.LeakyReLU()]


def has_attention(weights: dict[str, torch.Tensor]) -> bool:
    """Whether there is attention at the coarsest scale, by the names of either taming-transformers or diffusers."""
    return any(re.search(r"encoder\.down(\.\d+\.attn|_blocks\.\d+\.attentions)\.", name) for name in weights)


def from_taming(weights: dict[str, torch.Tensor], levels: int) -> dict[str, torch.Tensor]:
    """Diffusers' names for the weights of a VQGAN that was trained with taming-transformers; its losses are left out."""
    renamed = {}
    for name, tensor in weights.items():
        if name.startswith("loss."):
            continue
        name = re.sub(r"\.down\.(\d+)\.", r".down_blocks.\1.", name)
        name = re.sub(r"\.up\.(\d+)\.", lambda match: f".up_blocks.{levels - 1 - int(match[1])}.", name)
        name = re.sub(r"\.block\.(\d+)\.", r".resnets.\1.", name)
        name = re.sub(r"\.mid\.block_(\d)\.", lambda match: f".mid_block.resnets.{int(match[1]) - 1}.", name)
        name = name.replace(".nin_shortcut.", ".conv_shortcut.").replace(".norm_out.", ".conv_norm_out.")
        name = name.replace(".downsample.", ".downsamplers.0.").replace(".upsample.", ".upsamplers.0.")
        name = name.replace(".mid.attn_1.", ".mid_block.attentions.0.")
        name = re.sub(r"\.attn\.(\d+)\.", r".attentions.\1.", name)
        if ".attentions." in name:
            stem, part, kind = re.match(r"(.*\.attentions\.\d+)\.(\w+)\.(\w+)", name).groups()
            name = f"{stem}.{IN_ATTENTION[part]}.{kind}"
            tensor = tensor.flatten(1) if tensor.ndim == 4 else tensor  # convolutions of one pixel
        renamed[name] = tensor
    return renamed
