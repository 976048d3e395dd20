"""Observation encoders: one network per camera, tactile sensor and modality; their features are concatenated."""

import logging
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn as nn

from manifeel_ms3 import plugins
from manifeel_ms3.arguments import require_at_least
from manifeel_ms3.errors import InvalidArgumentError, UnknownNameError
from manifeel_ms3.files import file_hash

from .images import network_images
from .observation import POSE, ImageSizeError, ObservationSpec, is_tactile

log = logging.getLogger(__name__)
HASH_DIGITS = 16
"""Number of hexadecimal digits of the hash by which a run's settings name the weights that it began with."""


@dataclass
class EncoderConfig:
    """The networks that encode a policy's observations; the defaults are those of the paper's public code.

    Raises:
        InvalidArgumentError: A number of features is less than 1, or the side of a crop less than 0.
    """

    image: str = "resnet18"
    """Network of each camera: "resnet18" averages its features over the image, as the paper's public code does;
    "resnet18_keypoints" has the spatial softmax of the paper's text; "small_cnn" is for a CPU, "fine_cnn" for a CPU and
    images of 160 pixels."""
    tacrgb: str = "resnet18"
    """Network of each TacRGB image: one of the networks of cameras, "unit", "unit_released", "t3", "anytouch", "sparsh", or one
    that another package adds."""
    freeze_tacrgb: bool = False
    """Keep the weights of a pretrained TacRGB network as they were loaded, and train only the layers after it."""
    tacrgb_sensor: str | None = None
    """Sensor whose published weights the TacRGB network uses, if every sensor has weights of its own (t3: "mini", "gs_green",
    ...; anytouch: "gelsight", "gelsight_mini", ...); if not given, the first, which the paper's public code uses."""
    force_field: str = "resnet18"
    """Network of each TacFF force field: "resnet18" as in the paper, or "small", which is for a CPU."""
    image_features: int = 512
    """Number of features of each camera image. With "resnet18_keypoints" they are the two coordinates of half as many points,
    of which Diffusion Policy has 32."""
    tactile_features: int = 512
    """Number of features of each TacRGB image and of each TacFF force field; 512 as in the paper's public code."""
    crop: int = 0
    """Side of the square crops of camera images, pixels: random in training, central in evaluation; whole images if 0."""
    tactile_crop: int = 0
    """The same of TacRGB images. By default they are whole, because it matters where the gel is pressed; crops that are
    smaller by a few pixels keep a policy from recognising each demonstration by its images."""

    def __post_init__(self):
        require_at_least(1, image_features=self.image_features, tactile_features=self.tactile_features)
        require_at_least(0, crop=self.crop, tactile_crop=self.tactile_crop)

    def crop_of(self, key: str) -> int:
        """Side of the crops of an image, pixels; 0 for the whole image."""
        return self.tactile_crop if is_tactile(key) else self.crop


class SpatialSoftmax(nn.Module):
    """Expected image coordinates of `points` learned features (Levine et al. 2016): (B, C, H, W) -> (B, 2 points)."""

    def __init__(self, channels: int, points: int):
        super().__init__()
        self.score = nn.Conv2d(channels, points, 1)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        heat = self.score(features)
        weight = heat.flatten(2).softmax(-1).view_as(heat)
        y, x = (torch.linspace(-1, 1, n, device=heat.device) for n in heat.shape[2:])
        return torch.cat([(weight.sum(2) * x).sum(-1), (weight.sum(3) * y).sum(-1)], dim=1)


RESNET18_WIDTHS, RESNET18_DEPTHS = (64, 128, 256, 512), (2, 2, 2, 2)
"""Channels and number of blocks of each stage of ResNet-18 (He et al. 2016, table 1)."""


class ResNet18(nn.Module):
    """ResNet-18 from scratch with GroupNorm, as in Diffusion Policy: batch statistics conflict with an EMA of the weights."""

    out_channels = RESNET18_WIDTHS[-1]

    def __init__(self):
        from transformers import ResNetConfig, ResNetModel  # imported here, because it takes seconds

        super().__init__()
        widths, depths = list(RESNET18_WIDTHS), list(RESNET18_DEPTHS)
        config = ResNetConfig(depths=depths, layer_type="basic", hidden_sizes=widths, embedding_size=widths[0])
        self.net = _with_group_norm(ResNetModel(config))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.net(image).last_hidden_state


CHANNELS_PER_GROUP = 16
"""Number of channels that GroupNorm normalises together in ResNet-18, as in the public code of Diffusion Policy."""


def _with_group_norm(module: nn.Module) -> nn.Module:
    for name, child in module.named_children():
        if isinstance(child, nn.BatchNorm2d):
            setattr(module, name, nn.GroupNorm(child.num_features // CHANNELS_PER_GROUP, child.num_features))
        else:
            _with_group_norm(child)
    return module


NORM_GROUPS = 8
"""Number of groups of GroupNorm in the small networks; set once, not tuned."""
SMALL_STRIDE, SMALL_WIDTHS, SMALL_KERNEL, SMALL_PLACE_CHANNELS = 8, (24, 48, 64, 64), 5, 16
"""Total stride of `SmallCNN`, channels of its convolutions, kernel size of the first one, and channels at each place that its
last layer reads; chosen for training on a CPU."""
FINE_STRIDE, FINE_WIDTHS, FINE_KERNEL, FINE_PLACE_CHANNELS = 16, (32, 48, 48, 64), 7, 8
"""The same sizes of `FineCNN`, chosen for training on a CPU, too."""
FINE_FIRST_STRIDE = 4
"""Stride of the first convolution of `FineCNN`, so that images of 160 pixels cost what `SmallCNN` needs for 80."""
FIELD_WIDTH = 32
"""Number of channels of the convolutions of `SmallFieldNet`; chosen for training on a CPU."""


class SmallCNN(nn.Sequential):
    """A small image network for a CPU: four convolutions with a total stride of 8, then one layer over all places.

    On a few demonstrations it learns to locate a part in the image in a quarter of the steps that key points need.
    """

    def __init__(self, size: int, features: int):
        places = math.ceil(size / SMALL_STRIDE) ** 2
        first, second, third, fourth = SMALL_WIDTHS
        super().__init__(
            *_conv(3, first, kernel_size=SMALL_KERNEL, stride=2),
            *_conv(first, second, stride=2),
            *_conv(second, third, stride=2),
            *_conv(third, fourth),
            *_over_places(fourth, SMALL_PLACE_CHANNELS, places, features),
        )


class FineCNN(nn.Sequential):
    """A small image network for a CPU that sees fine detail, by a large kernel and stride in its first convolution."""

    def __init__(self, size: int, features: int):
        places = math.ceil(size / FINE_STRIDE) ** 2
        first, second, third, fourth = FINE_WIDTHS
        super().__init__(
            *_conv(3, first, kernel_size=FINE_KERNEL, stride=FINE_FIRST_STRIDE),
            *_conv(first, second, stride=2),
            *_conv(second, third),
            *_conv(third, fourth, stride=2),
            *_over_places(fourth, FINE_PLACE_CHANNELS, places, features),
        )


def _conv(inputs: int, outputs: int, kernel_size: int = 3, stride: int = 1) -> list[nn.Module]:
    return [nn.Conv2d(inputs, outputs, kernel_size, stride, kernel_size // 2), nn.GroupNorm(NORM_GROUPS, outputs), nn.SiLU()]


def _over_places(inputs: int, channels: int, places: int, features: int) -> list[nn.Module]:
    """A few channels at each place, and one layer over all places."""
    return [nn.Conv2d(inputs, channels, 1), nn.Flatten(), nn.Linear(channels * places, features), nn.SiLU()]


class SmallFieldNet(nn.Module):
    """A small force field network: two convolutions, then one layer over all places, because the place matters."""

    def __init__(self, taxel_shape: tuple[int, int], features: int):
        super().__init__()
        rows, columns = (math.ceil(side / 2) for side in taxel_shape)
        self.net = nn.Sequential(
            *_conv(3, FIELD_WIDTH),
            *_conv(FIELD_WIDTH, FIELD_WIDTH, stride=2),
            nn.Flatten(),
            nn.Linear(FIELD_WIDTH * rows * columns, features),
            nn.SiLU(),
        )

    def forward(self, field: torch.Tensor) -> torch.Tensor:
        return self.net(field)


class PretrainedEncoder(nn.Module):
    """An image encoder with a pretrained part. Subclasses define all methods."""

    def freeze(self) -> None:
        """Exclude the pretrained part from training."""
        raise NotImplementedError

    def choose_sensor(self, name: str) -> None:
        """Use the published weights of the sensor of this name."""
        raise NotImplementedError

    def load(self, weights: Path) -> None:
        """Load the weights of the pretrained part."""
        raise NotImplementedError

    def fit(self, images: Iterable[torch.Tensor]) -> None:
        """Take the statistics that the network needs from the training images, uint8 (S, H, W, 3) each."""
        raise NotImplementedError


def load_pretrained(policy: nn.Module, weights: Path | None) -> str | None:
    """Load weights into the pretrained part of every TacRGB encoder of a policy; warn if it has one, and no weights are given.

    Returns:
        The name of the file and the beginning of its SHA-256, which tell these weights from all others; None without weights.

    Raises:
        InvalidArgumentError: No encoder of the policy has a pretrained part.
        CheckpointError: The weights belong to another architecture.
    """
    encoders = [module for module in policy.modules() if isinstance(module, PretrainedEncoder)]
    if weights is None:
        if encoders:
            log.warning("the TacRGB encoder begins with random weights; --tacrgb-weights gives it pretrained ones")
        return None
    if not encoders:
        raise InvalidArgumentError(
            f"tacrgb_weights={weights}: no network of this policy takes them; choose one that does, such as "
            "--policy.encoder.tacrgb t3"
        )
    for encoder in encoders:
        encoder.load(weights)
    return f"{weights.name} {file_hash(weights)[:HASH_DIGITS]}"


def _key_points(_size: int, features: int) -> nn.Module:
    if features % 2:
        raise InvalidArgumentError(
            f"{features} features cannot be pairs of coordinates; 'resnet18_keypoints' needs an even number"
        )
    return nn.Sequential(ResNet18(), SpatialSoftmax(ResNet18.out_channels, features // 2))


def _pooled(_shape: int | tuple[int, int], features: int) -> nn.Module:
    """The mean of ResNet-18's features over all places, with a further layer if another number of features is asked for."""
    pooled = [ResNet18(), nn.AdaptiveAvgPool2d(1), nn.Flatten()]
    if features == ResNet18.out_channels:
        return nn.Sequential(*pooled)
    return nn.Sequential(*pooled, nn.Linear(ResNet18.out_channels, features), nn.ReLU())  # as in the public code of EquiDP


MakeImageEncoder = Callable[[int, int], nn.Module]
"""Function from the side of the image, pixels, and a number of features to a network (B, 3, size, size) -> (B, features)."""
IMAGE_ENCODERS: dict[str, MakeImageEncoder] = {
    "resnet18": _pooled,
    "resnet18_keypoints": _key_points,
    "small_cnn": SmallCNN,
    "fine_cnn": FineCNN,
}
"""Networks over camera images."""
TACRGB_ENCODERS: dict[str, MakeImageEncoder] = dict(IMAGE_ENCODERS)
"""Networks over TacRGB images that were registered; those of installed packages are plug-ins (`tacrgb_encoder_names`)."""
FIELD_ENCODERS: dict[str, Callable[[tuple[int, int], int], nn.Module]] = {
    "resnet18": _pooled,  # as in the paper: the force field is a small image, which ResNet-18 shrinks to a single place
    "small": SmallFieldNet,
}
"""Functions from the rows and columns of taxels and a number of features to a network (B, 3, rows, columns) -> (B,
features)."""


def register_tacrgb_encoder(name: str, make: MakeImageEncoder) -> None:
    """Add a network for TacRGB images that every policy of this process can use.

    An installed package names its networks as entry points instead (`docs/extending.md`), so that every process finds them.

    Args:
        name: Name by which `EncoderConfig.tacrgb` chooses it.
        make: Function from the side of the image, pixels, and a number of features to a network
            (B, 3, size, size) -> (B, features).

    Raises:
        InvalidArgumentError: The name is taken.
    """
    if name in TACRGB_ENCODERS:
        raise InvalidArgumentError(f"the TacRGB encoder {name!r} is registered already; choose another name")
    TACRGB_ENCODERS[name] = make


def tacrgb_encoder_names() -> tuple[str, ...]:
    """Names of the networks over TacRGB images, those of other packages included."""
    return tuple(sorted({*TACRGB_ENCODERS, *plugins.registered(plugins.ENCODERS)}))


def _tacrgb_encoder(name: str) -> MakeImageEncoder:
    """The function that makes the network over TacRGB images of this name.

    Raises:
        UnknownNameError: No network has this name.
        PluginError: The plug-in that makes it does not import.
    """
    if name not in (known := tacrgb_encoder_names()):
        raise UnknownNameError(f"encoder {name!r} is unknown; choose from {list(known)}")
    return TACRGB_ENCODERS[name] if name in TACRGB_ENCODERS else plugins.load(plugins.ENCODERS, name)


def image_encoder(config: EncoderConfig, spec: ObservationSpec, key: str) -> nn.Module:
    """The network of one camera or TacRGB image.

    Raises:
        UnknownNameError: No network has the configured name.
        InvalidArgumentError: The network does not take images of this size, or cannot be frozen.
    """
    size = network_size(config, spec, key)
    if not is_tactile(key):
        return by_name(IMAGE_ENCODERS, config.image)(size, config.image_features)
    try:
        encoder = _tacrgb_encoder(config.tacrgb)(size, config.tactile_features)
    except ImageSizeError as error:
        uncropped = " --policy.encoder.tactile-crop 0" if size < spec.size_of(key) else ""
        raise ImageSizeError(f"{error}{uncropped}") from None
    if config.freeze_tacrgb or config.tacrgb_sensor:
        if not isinstance(encoder, PretrainedEncoder):
            raise InvalidArgumentError(
                f"{config.tacrgb!r} has no pretrained weights; leave out freeze_tacrgb and tacrgb_sensor"
            )
        if config.freeze_tacrgb:
            encoder.freeze()
        if config.tacrgb_sensor:
            encoder.choose_sensor(config.tacrgb_sensor)
    return encoder


def network_size(config: EncoderConfig, spec: ObservationSpec, key: str) -> int:
    """Side of an image that a network gets, pixels; a crop that is larger than the image leaves it whole."""
    return min(config.crop_of(key) or spec.size_of(key), spec.size_of(key))


def field_encoder(config: EncoderConfig, spec: ObservationSpec) -> nn.Module:
    """The network of one TacFF force field.

    Raises:
        UnknownNameError: No network has the configured name.
    """
    return by_name(FIELD_ENCODERS, config.force_field)(spec.taxel_shape, config.tactile_features)


def by_name(table: dict[str, Callable], name: str) -> Callable:
    """The function of a table that makes the network of this name.

    Raises:
        UnknownNameError: No network has this name; the message lists the known names.
    """
    if name not in table:
        raise UnknownNameError(f"encoder {name!r} is unknown; choose from {sorted(table)}")
    return table[name]


class ObservationEncoder(nn.Module):
    """Features (B, obs_horizon * F) of a window of observations; a sensor's network is shared over time steps.

    Args:
        config: Names of the networks.
        spec: Observations of the policy.
        obs_horizon: Number of time steps in a window.

    Raises:
        UnknownNameError: No network has a configured name.
        InvalidArgumentError: A network does not take images of this size, or cannot be frozen.
    """

    def __init__(self, config: EncoderConfig, spec: ObservationSpec, obs_horizon: int):
        super().__init__()
        self.config, self.spec = config, spec
        self.images = nn.ModuleList(image_encoder(config, spec, key) for key in spec.images)
        self.fields = nn.ModuleList(field_encoder(config, spec) for _ in spec.force_fields)
        pads = sum(map(is_tactile, spec.images)) + len(self.fields)
        cameras = len(spec.images) + len(self.fields) - pads
        self.out_features = obs_horizon * (
            config.image_features * cameras + config.tactile_features * pads + spec.pose_features
        )

    def forward(self, obs: dict[str, torch.Tensor]) -> torch.Tensor:
        """Encode observations {key: (B, obs_horizon, ...)}: images as uint8 or normalised, the rest as normalised floats."""
        batch, horizon = obs[POSE].shape[:2]
        features = [obs[POSE].flatten(0, 1)]
        for key, net in zip(self.spec.images, self.images, strict=True):
            features.append(net(network_images(obs[key], self.config.crop_of(key), self.training)))
        for key, net in zip(self.spec.force_fields, self.fields, strict=True):
            features.append(net(obs[key].flatten(0, 1).movedim(-1, 1)))
        return torch.cat(features, dim=-1).view(batch, horizon, -1).flatten(1)
