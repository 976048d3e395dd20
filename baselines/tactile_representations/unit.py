"""UniT (Xu et al. 2025, "Data Efficient Tactile Representation with Generalization to Unseen Objects"): a VQGAN's encoder.

It is trained on TacRGB images of a few simple objects (`pretrain.py`), in the paper ManiFeel on those of nut-and-bolt assembly
alone. A policy takes the latents before their quantisation, and trains a head over them.
"""

import re
from itertools import pairwise

import torch
import torch.nn as nn

from manifeel_ms3.evaluation.checkpoint_config import CheckpointError

from .representation import Representation, in_unit_range

LATENT_CHANNELS, CODES = 3, 1024
"""Channels of the latents and size of the codebook, as in the released checkpoint."""
CHANNELS = (128, 128, 256, 512)
"""Channels from the finest to the coarsest scale, as in the released checkpoint."""
HEAD_CHANNELS = (128, 256, 512)
"""Channels of the head's convolutions, as in both public codes (ZhengtongXu/UniT and purdue-mars/manifeel)."""
HEAD_SLOPE = 0.01
"""Slope of the head's activations for negative inputs, torch's default."""
RELEASED_SIZE, SIZE = 128, 256
"""Height of the images, in pixels, of the released checkpoint and of the paper ManiFeel."""
HEAD_HIDDEN = 512
"""Features of the head's two hidden layers, as in ManiFeel's public code."""
DIFFUSERS_ATTENTION = {"norm": "group_norm", "q": "to_q", "k": "to_k", "v": "to_v", "proj_out": "to_out.0"}
"""Names of attention layers: taming-transformers' to diffusers'."""


class UniT(Representation):
    """UniT's VQGAN: latents (B, 3, H / 8, W / 8).

    Args:
        channels: Channels from the finest to the coarsest scale.
        attention: Whether the coarsest scale has attention, as in the weights that UniT's authors released, which were trained
            on 128 x 160 pixels; the paper ManiFeel uses 256 x 256 pixels and no attention.
    """

    patch, size, out_features = 8, SIZE, LATENT_CHANNELS
    released = "a checkpoint of UniT's VQGAN"

    def __init__(self, channels: tuple[int, ...] = CHANNELS, attention: bool = False):
        from diffusers import VQModel  # pyright: ignore[reportPrivateImportUsage] (imported here, because it takes seconds)

        super().__init__()
        if attention:
            self.size = RELEASED_SIZE
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

    def forward(self, image):
        return self.vqgan.encode(in_unit_range(image)).latents

    def unused_parts(self):
        return self.vqgan.quantize, self.vqgan.post_quant_conv, self.vqgan.decoder

    def head(self, features):
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise((LATENT_CHANNELS, *HEAD_CHANNELS)):
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), ChannelNorm(outputs), nn.LeakyReLU(HEAD_SLOPE)]
        layers += [nn.AdaptiveAvgPool2d(1), nn.Flatten()]
        layers += [nn.Linear(HEAD_CHANNELS[-1], HEAD_HIDDEN), nn.ReLU(), nn.Linear(HEAD_HIDDEN, HEAD_HIDDEN), nn.ReLU()]
        return nn.Sequential(*layers, nn.Linear(HEAD_HIDDEN, features))

    def convert_state_dict(self, weights):
        if has_attention(weights) and not has_attention(self.state_dict()):
            raise CheckpointError(
                "the weights have attention at the coarsest scale; give --policy.encoder.tacrgb unit_released"
            )
        return {f"vqgan.{n}": t for n, t in from_taming(weights, len(self.vqgan.config["block_out_channels"])).items()}


class ChannelNorm(nn.LayerNorm):
    """Layer norm over the channels of each place of an image (B, C, H, W)."""

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return super().forward(image.movedim(1, -1)).movedim(-1, 1)


def has_attention(weights: dict[str, torch.Tensor]) -> bool:
    """Whether weights named by taming-transformers or by diffusers have attention at the coarsest scale."""
    return any(re.search(r"encoder\.down(\.\d+\.attn|_blocks\.\d+\.attentions)\.", name) for name in weights)


def from_taming(weights: dict[str, torch.Tensor], levels: int) -> dict[str, torch.Tensor]:
    """Weights of a VQGAN trained with taming-transformers under diffusers' names, without those of its losses.

    Args:
        weights: The weights under the names of taming-transformers.
        levels: Number of scales.
    """
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
            stem, part, kind = name.rsplit(".", 2)
            name = f"{stem}.{DIFFUSERS_ATTENTION[part]}.{kind}"
            tensor = tensor.flatten(1) if tensor.ndim == 4 else tensor  # convolutions of one pixel become linear layers
        renamed[name] = tensor
    return renamed
