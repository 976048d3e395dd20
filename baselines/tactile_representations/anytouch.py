"""AnyTouch (Feng et al. 2025, "Learning Unified Static-Dynamic Representation across Multiple Visuo-tactile Sensors").

CLIP's ViT-L/14 with additional tokens that name the sensor; an image enters as a video of three equal frames. The feature is
the class token, normalised and projected to CLIP's embedding space, as in the paper's public code. 305 M parameters.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
import torch.nn as nn

from .representation import ColourNormalisation, TokenRepresentation, under_prefix
from .vit import interpolate_pos_embed

if TYPE_CHECKING:
    from transformers import CLIPVisionConfig

SENSORS = {"gelsight": 0, "digit": 1, "gelslim": 2, "gelsight_mini": 3, "duragel": 4, "universal": 9}
"""Indices of the sensors among the tokens of the published checkpoint; "universal" stands for any sensor. The paper's public
code takes the first."""
NUM_SENSORS, SENSOR_TOKENS = 10, 5
"""Number of sensors in the published checkpoint, some of them unused, and number of tokens for each."""
FRAMES, COLOURS = 3, 3
"""Number of video frames that a patch covers, and of colours of a frame."""
PREFIX = "touch_mae_model."
"""Prefix of the touch encoder's weights in the checkpoint of the second training stage, beside CLIP's text and vision."""
ONLY_FOR_TRAINING = (
    *("touch_decoder_blocks.", "decoder_embed.", "decoder_norm.", "decoder_pred.", "decoder_pred_video.", "decoder_pos_embed"),
    *("mask_token", "sensor_token_proj.", "video_position_embedding."),
    *("touch_model.embeddings.patch_embedding.", "touch_model.embeddings.position_ids"),
)
"""Beginnings of the names of weights that the feature does not depend on: the decoder of masked autoencoding, and the patch
embedding of single images, in whose place the video's is used."""
VIT_LARGE: dict[str, Any] = dict(
    hidden_size=1024,
    intermediate_size=4096,
    num_hidden_layers=24,
    num_attention_heads=16,
    patch_size=14,
    projection_dim=768,
    hidden_act="gelu",  # of the CLIP checkpoint that AnyTouch starts from (laion/CLIP-ViT-L-14-DataComp.XL-s13B-b90K)
)
"""Settings of CLIP's vision model."""


class AnyTouch(TokenRepresentation):
    """AnyTouch's touch encoder, with the projection to CLIP's embedding space."""

    patch, size, leading = 14, 224, 1 + SENSOR_TOKENS
    released = "checkpoint.pth of AnyTouch"
    sensors, sensor = SENSORS, "gelsight"

    def __init__(self, config: CLIPVisionConfig | None = None):
        from transformers import CLIPVisionConfig, CLIPVisionModel  # imported here, because it takes seconds

        super().__init__()
        config = config or CLIPVisionConfig(**VIT_LARGE)
        self.width, self.out_features = config.hidden_size, config.projection_dim
        self.sensor_token = nn.Parameter(torch.zeros(NUM_SENSORS, SENSOR_TOKENS, self.width))
        clip = CLIPVisionModel(config)
        self.touch_model: Any = getattr(clip, "vision_model", clip)  # transformers 4 wraps it
        block = (COLOURS, self.patch, self.patch)  # the authors stack frames first: frames are channels, colours are depth
        self.touch_model.embeddings.patch_embedding = nn.Conv3d(FRAMES, self.width, block, block, bias=False)
        self.touch_projection = nn.Linear(self.width, self.out_features, bias=False)
        self.normalisation = ColourNormalisation()  # always ImageNet's, as the authors train and evaluate

    def prepare(self, image):
        return self.normalisation(image)

    def embed(self, prepared):
        video = prepared[:, None].expand(-1, FRAMES, -1, -1, -1)  # (B, frame, colour, H, W)
        patches = self.touch_model.embeddings.patch_embedding(video).flatten(2).transpose(1, 2)
        grid = [side // self.patch for side in prepared.shape[2:]]
        return patches + interpolate_pos_embed(self.touch_model.embeddings.position_embedding.weight[None, 1:], grid)

    def encode(self, tokens):
        embeddings = self.touch_model.embeddings
        first = (embeddings.class_embedding + embeddings.position_embedding.weight[0]).expand(len(tokens), 1, -1)
        sensor = self.sensor_token[SENSORS[self.sensor]].expand(len(tokens), -1, -1)
        tokens = self.touch_model.pre_layrnorm(torch.cat([first, sensor, tokens], dim=1))
        return self.touch_model.encoder(inputs_embeds=tokens).last_hidden_state

    def pool(self, tokens):
        return self.touch_projection(self.touch_model.post_layernorm(tokens[:, 0]))

    def convert_state_dict(self, weights):
        released = under_prefix(weights, PREFIX) or weights
        own = {name: tensor for name, tensor in released.items() if not name.startswith(ONLY_FOR_TRAINING)}
        own["touch_model.embeddings.patch_embedding.weight"] = own.pop("video_patch_embedding.weight")
        return own
