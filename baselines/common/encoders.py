"""Observation encoders: one network per camera, pad and modality, their features joined."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn as nn
from transformers import ResNetConfig, ResNetModel

from baselines.tactile_representations.anytouch import AnyTouch
from baselines.tactile_representations.representation import Representation
from baselines.tactile_representations.sparsh import Sparsh
from baselines.tactile_representations.t3 import T3
from baselines.tactile_representations.unit import UniT

from .observation import POSE, POSE_FEATURES, ObservationSpec, is_tactile

IMAGE_FEATURES = 64  # per image: 32 key points


@dataclass
class EncoderConfig:
    image: str = "resnet18"
    """network of each camera, by its name in IMAGE_ENCODERS"""
    tacrgb: str = "resnet18"
    """network of each TacRGB image, by its name in TACRGB_ENCODERS"""
    freeze_tacrgb: bool = False
    """leave a tactile representation as it was loaded, and train what follows it"""
    force_field: str = "resnet18"
    """network of each TacFF field, by its name in FIELD_ENCODERS"""
    crop: int = 0
    """random crops of this size in training, the middle in evaluation; 0: whole images"""


class SpatialSoftmax(nn.Module):
    """Expected image coordinates of `points` learned features (Levine et al. 2016): (B, C, H, W) -> (B, 2 points)."""

    def __init__(self, channels: int, points: int = IMAGE_FEATURES // 2):
        super().__init__()
        self.score = nn.Conv2d(channels, points, 1)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        heat = self.score(features)
        weight = heat.flatten(2).softmax(-1).view_as(heat)
        y, x = (torch.linspace(-1, 1, n, device=heat.device) for n in heat.shape[2:])
        return torch.cat([(weight.sum(2) * x).sum(-1), (weight.sum(3) * y).sum(-1)], dim=1)


class ResNet18(nn.Module):
    """ResNet-18 from scratch with GroupNorm, as in Diffusion Policy (EMA and batch statistics do not go together)."""

    def __init__(self):
        super().__init__()
        config = ResNetConfig(depths=[2, 2, 2, 2], layer_type="basic", hidden_sizes=[64, 128, 256, 512], embedding_size=64)
        self.net = _with_group_norm(ResNetModel(config))
        self.out_channels = 512

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.net(image).last_hidden_state


def _with_group_norm(module: nn.Module) -> nn.Module:
    for name, child in module.named_children():
        if isinstance(child, nn.BatchNorm2d):
            setattr(module, name, nn.GroupNorm(child.num_features // 16, child.num_features))
        else:
            _with_group_norm(child)
    return module


class SmallCNN(nn.Sequential):
    """A small image network for a CPU: four convolutions, stride 8 in all, then every place at once.

    On a few demonstrations it finds a part in the picture in a quarter of the steps that key points take.
    """

    def __init__(self, size: int):
        places = math.ceil(size / 8) ** 2
        super().__init__(
            *_conv(3, 24, kernel=5, stride=2),
            *_conv(24, 48, stride=2),
            *_conv(48, 64, stride=2),
            *_conv(64, 64),
            nn.Conv2d(64, 16, 1),
            nn.Flatten(),
            nn.Linear(16 * places, IMAGE_FEATURES),
            nn.SiLU(),
        )


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> list[nn.Module]:
    return [nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2), nn.GroupNorm(8, outputs), nn.SiLU()]


class RepresentationEncoder(nn.Module):
    """A tactile representation, and a layer to as many features as other images have."""

    def __init__(self, representation: Representation, size: int):
        super().__init__()
        if size % representation.patch:
            name, patch = type(representation).__name__, representation.patch
            raise ValueError(f"{name} takes pictures whose sides are a multiple of {patch}, not {size}; give --image-size 224")
        self.representation, self.frozen = representation, False
        self.out = nn.Linear(representation.out_features, IMAGE_FEATURES)

    def freeze(self) -> None:
        self.representation.requires_grad_(False)
        self.frozen = True

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            features = self.representation(image)
        return self.out(features)


def load_representations(policy: nn.Module, weights: Path) -> None:
    """Load weights into every tactile representation of a policy.

    Raises:
        ValueError: it has none.
        CheckpointError: the weights are of something else.
    """
    encoders = [module for module in policy.modules() if isinstance(module, RepresentationEncoder)]
    if not encoders:
        raise ValueError(f"{weights} are given for TacRGB, but no network takes them; give --policy.encoder.tacrgb t3, say")
    for encoder in encoders:
        encoder.representation.load(weights)


class SmallFieldNet(nn.Module):
    """A force field's 10 x 14 taxels through two convolutions, then all of them at once: its places carry meaning."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(
            *_conv(3, 32), *_conv(32, 32, stride=2), nn.Flatten(), nn.Linear(32 * 5 * 7, IMAGE_FEATURES), nn.SiLU()
        )

    def forward(self, field: torch.Tensor) -> torch.Tensor:
        return self.net(field)


def _key_points(backbone: nn.Module) -> nn.Module:
    return nn.Sequential(backbone, SpatialSoftmax(backbone.out_channels))


def _pooled(backbone: nn.Module) -> nn.Module:
    """A field of 10 x 14 shrinks to one place, which leaves no key points: its features themselves."""
    return nn.Sequential(backbone, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(backbone.out_channels, IMAGE_FEATURES))


IMAGE_ENCODERS: dict[str, Callable[[int], nn.Module]] = {  # of the picture's size, pixels
    "resnet18": lambda size: _key_points(ResNet18()),
    "small_cnn": SmallCNN,
}
TACRGB_ENCODERS: dict[str, Callable[[int], nn.Module]] = IMAGE_ENCODERS | {
    "unit": lambda size: RepresentationEncoder(UniT(), size),
    "unit_released": lambda size: RepresentationEncoder(UniT(attention=True), size),
    "t3": lambda size: RepresentationEncoder(T3(), size),
    "anytouch": lambda size: RepresentationEncoder(AnyTouch(), size),
    "sparsh": lambda size: RepresentationEncoder(Sparsh(), size),
}
FIELD_ENCODERS: dict[str, Callable[[], nn.Module]] = {
    "resnet18": lambda: _pooled(ResNet18()),  # the paper's: the field as a small image
    "small": SmallFieldNet,
}


def image_encoder(config: EncoderConfig, spec: ObservationSpec, key: str) -> nn.Module:
    """The network of one camera or TacRGB image.

    Raises:
        ValueError: its name is unknown, or it does not take pictures of this size.
    """
    size = config.crop or spec.image_size
    if not is_tactile(key):
        return _known(IMAGE_ENCODERS, config.image)(size)
    encoder = _known(TACRGB_ENCODERS, config.tacrgb)(size)
    if config.freeze_tacrgb:
        if not isinstance(encoder, RepresentationEncoder):
            raise ValueError(f"freeze_tacrgb: {config.tacrgb!r} is no representation that could be loaded; leave it False")
        encoder.freeze()
    return encoder


def field_encoder(config: EncoderConfig) -> nn.Module:
    """The network of one TacFF field.

    Raises:
        ValueError: its name is unknown.
    """
    return _known(FIELD_ENCODERS, config.force_field)()


def _known(table: dict, name: str) -> Callable:
    if name not in table:
        raise ValueError(f"encoder {name!r} is unknown; choose from {sorted(table)}")
    return table[name]


class ObservationEncoder(nn.Module):
    """Features (B, obs_horizon * F) of a window of observations; networks are shared over time, not over sensors.

    Raises:
        ValueError: an encoder's name is unknown, or it does not take pictures of this size.
    """

    def __init__(self, config: EncoderConfig, spec: ObservationSpec, obs_horizon: int):
        super().__init__()
        self.crop, self.spec = config.crop, spec
        self.images = nn.ModuleList(image_encoder(config, spec, key) for key in spec.images)
        self.fields = nn.ModuleList(field_encoder(config) for _ in spec.force_fields)
        per_step = IMAGE_FEATURES * (len(self.images) + len(self.fields)) + POSE_FEATURES
        self.out_features = obs_horizon * per_step

    def forward(self, obs: dict[str, torch.Tensor]) -> torch.Tensor:
        """`obs`: {key: (B, obs_horizon, ...)}: images uint8, the rest normalised floats."""
        batch, horizon = obs[POSE].shape[:2]
        features = [obs[POSE].flatten(0, 1)]
        for key, net in zip(self.spec.images, self.images, strict=True):
            features.append(net(cropped(obs[key], self.crop, self.training).flatten(0, 1).movedim(-1, 1).float() / 127.5 - 1.0))
        for key, net in zip(self.spec.force_fields, self.fields, strict=True):
            features.append(net(obs[key].flatten(0, 1).movedim(-1, 1)))
        return torch.cat(features, dim=-1).view(batch, horizon, -1).flatten(1)


def cropped(images: torch.Tensor, size: int, at_random: bool) -> torch.Tensor:
    """Crop (B, T, H, W, 3) to squares: at random, the same over a window's time, or the middle; 0: leave it whole."""
    free = images.shape[2] - size
    if not 0 < size < images.shape[2]:
        return images
    if not at_random:
        return images[:, :, free // 2 : free // 2 + size, free // 2 : free // 2 + size]
    batch = torch.arange(len(images), device=images.device)
    top, left = torch.randint(free + 1, (2, len(images)), device=images.device)
    span = torch.arange(size, device=images.device)
    rows, cols = (top[:, None] + span)[:, :, None], (left[:, None] + span)[:, None, :]
    return images.movedim(1, 3)[batch[:, None, None], rows, cols].movedim(3, 1)
