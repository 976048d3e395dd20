"""AnyTouch (Feng et al. 2025, "Learning Unified Static-Dynamic Representation across Multiple Visuo-tactile Sensors").

CLIP's ViT-L/14 with additional tokens that name the sensor; an image enters as a video of three equal frames. 305 M parameters.
"""

from typing import Any

import torch
import torch.nn as nn
from transformers import CLIPVisionConfig, CLIPVisionModel

from .representation import TokenRepresentation, imagenet_normalised
from .vit import interpolate_pos_embed

SENSORS, SENSOR_TOKENS = 10, 5
"""Number of sensors in the published checkpoint, and number of tokens for each."""
GELSIGHT = 0
"""Index of the GelSight sensor among them."""
FRAMES = 3
"""Number of video frames that a patch covers."""
VIT_LARGE = CLIPVisionConfig(
    hidden_size=1024, intermediate_size=4096, num_hidden_layers=24, num_attention_heads=16, patch_size=14, projection_dim=768
)


class AnyTouch(TokenRepresentation):
    """AnyTouch's touch encoder, with the projection to CLIP's embedding space."""

    patch = 14

    def __init__(self, config: CLIPVisionConfig = VIT_LARGE):
        super().__init__()
        self.width, self.out_features = config.hidden_size, config.projection_dim
        self.sensor_token = nn.Parameter(torch.zeros(SENSORS, SENSOR_TOKENS, self.width))
        clip = CLIPVisionModel(config)
        self.touch_model: Any = getattr(clip, "vision_model", clip)  # transformers 4 wraps it
        frames = (FRAMES, self.patch, self.patch)
        self.touch_model.embeddings.patch_embedding = nn.Conv3d(3, self.width, frames, frames, bias=False)
        self.touch_projection = nn.Linear(self.width, self.out_features, bias=False)

    def embed(self, image):
        video = imagenet_normalised(image)[:, :, None].expand(-1, -1, FRAMES, -1, -1)
        patches = self.touch_model.embeddings.patch_embedding(video).flatten(2).transpose(1, 2)
        grid = [side // self.patch for side in image.shape[2:]]
        return patches + interpolate_pos_embed(self.touch_model.embeddings.position_embedding.weight[None, 1:], grid)

    def encode(self, tokens):
        embeddings = self.touch_model.embeddings
        first = (embeddings.class_embedding + embeddings.position_embedding.weight[0]).expand(len(tokens), 1, -1)
        sensor = self.sensor_token[GELSIGHT].expand(len(tokens), -1, -1)
        tokens = self.touch_model.pre_layrnorm(torch.cat([first, sensor, tokens], dim=1))
        tokens = self.touch_model.encoder(inputs_embeds=tokens).last_hidden_state
        return self.touch_model.post_layernorm(tokens)[:, 1 + SENSOR_TOKENS :]

    def forward(self, image):
        return self.touch_projection(super().forward(image))

    def convert_state_dict(self, weights):
        own = {name.removeprefix("touch_mae_model."): tensor for name, tensor in weights.items()}
        own = {n.replace("video_patch_embedding", "touch_model.embeddings.patch_embedding"): own[n] for n in _video_last(own)}
        wanted = self.state_dict()
        return {name: tensor for name, tensor in own.items() if name in wanted or name.startswith("touch_")}


def _video_last(names: dict[str, torch.Tensor]) -> list[str]:
    """The names, with the video's patch embedding last, because it replaces the one of still images."""
    return sorted(names, key=lambda name: "video_patch_embedding" in name)
