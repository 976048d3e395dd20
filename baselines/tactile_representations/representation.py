"""The base of tactile representations: networks over TacRGB images that take published weights or are trained here."""

from collections.abc import Collection, Iterable
from pathlib import Path

import torch
import torch.nn as nn

from baselines.common.checkpoint import holds_safetensors, read_tensors
from manifeel_ms3.errors import UnknownNameError
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError

from .released_weights import read_released

WEIGHT_TYPES = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
"""Types of numbers that a file's weights may have."""


class Representation(nn.Module):
    """Outputs (B, out_features, ...) for TacRGB images (B, 3, H, W) in [-1, 1], which it normalises as its authors do.

    Subclasses define the attributes, `forward` and `convert_state_dict`.
    """

    out_features: int
    """Number of features of the output."""
    patch: int
    """Number of pixels; both sides of the images must be a multiple of it."""
    size: int
    """Side of the images that its authors, or else the paper ManiFeel, give to it, pixels."""
    released: str
    """The weights that its authors released, for error messages."""
    sensors: Collection[str] = ()
    """Names of the sensors for which it has weights of their own; the first is the default."""

    def convert_state_dict(self, weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """The weights of a checkpoint that the authors released, under the names of this module."""
        raise NotImplementedError

    def unused_parts(self) -> Iterable[nn.Module]:
        """Parts that only pretraining uses. A policy does not train them; in several processes it could not."""
        return ()

    def head(self, features: int) -> nn.Module:
        """The layers from the output to `features` numbers (B, features), which each policy trains anew."""
        return nn.Linear(self.out_features, features)

    def fit(self, images: Iterable[torch.Tensor]) -> None:
        """Take the statistics that the network needs from the training images, uint8 (N, H, W, 3) each; by default none."""

    def choose_sensor(self, name: str) -> None:
        """Use the weights of the sensor of this name.

        Raises:
            UnknownNameError: The representation has no weights for this sensor.
        """
        if name not in self.sensors:
            kinds = f"choose from {list(self.sensors)}" if self.sensors else "it has the same weights for all; leave it out"
            raise UnknownNameError(f"tacrgb_sensor={name!r} is not a sensor of {type(self).__name__}; {kinds}")
        self.sensor = name

    def load(self, path: Path) -> None:
        """Load weights that `pretrain.py` wrote, or that the authors released, whatever the suffix of the file.

        Raises:
            CheckpointError: The file cannot be read, or belongs to another network.
        """
        weights, own = self.read(path), self.state_dict()
        if not weights.keys() <= own.keys():
            weights = self._converted(weights, path)
        buffers = {name: own[name] for name, _ in self.named_buffers() if name in own}  # the authors' files may lack them
        weights = buffers | weights
        wrong = [name for name in own if name not in weights or not _fits(weights[name], own[name])]
        wrong += [name for name in weights if name not in own]
        if wrong:
            raise CheckpointError(
                f"{path} holds the weights of another network than {type(self).__name__}: {len(wrong)} tensors do not fit, "
                f"first {wrong[0]!r}; give {self.released}, or a file that pretrain.py wrote for it"
            )
        self.load_state_dict(weights)

    def read(self, path: Path) -> dict[str, torch.Tensor]:
        """The tensors of a file by their names, without running anything that the file holds.

        Raises:
            CheckpointError: The file is missing or broken.
        """
        return read_tensors(path) if holds_safetensors(path) else read_released(path, self.released)

    def _converted(self, weights: dict[str, torch.Tensor], path: Path) -> dict[str, torch.Tensor]:
        try:
            return self.convert_state_dict(weights)
        except CheckpointError as error:
            raise CheckpointError(f"{path}: {error}") from error
        except (LookupError, ValueError, RuntimeError) as error:  # names and shapes of any file
            raise CheckpointError(
                f"{path} holds the weights of another network than {type(self).__name__} ({type(error).__name__}: {error}); "
                f"give {self.released}"
            ) from error


def _fits(tensor: torch.Tensor, own: torch.Tensor) -> bool:
    """Whether a tensor of a file can become a weight."""
    return tensor.shape == own.shape and tensor.dtype in WEIGHT_TYPES


class TokenRepresentation(Representation):
    """A transformer over image patches.

    Subclasses define the attributes and all methods but `forward`.
    """

    width: int
    """Number of features of a token."""
    leading: int
    """Number of tokens before those of the patches, such as the class token."""

    def prepare(self, image: torch.Tensor) -> torch.Tensor:
        """The images (B, 3, h, w) that the authors' preprocessing makes of images in [-1, 1]."""
        raise NotImplementedError

    def embed(self, prepared: torch.Tensor) -> torch.Tensor:
        """Tokens (B, N, width) of a prepared image's patches, their position embeddings added."""
        raise NotImplementedError

    def encode(self, tokens: torch.Tensor) -> torch.Tensor:
        """Output tokens (B, leading + n, width) of any subset of the patch tokens (B, n, width)."""
        raise NotImplementedError

    def pool(self, tokens: torch.Tensor) -> torch.Tensor:
        """Features (B, out_features) of output tokens."""
        raise NotImplementedError

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.pool(self.encode(self.embed(self.prepare(image))))


IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet's colours, as torchvision documents them."""


class ColourNormalisation(nn.Module):
    """Images in [-1, 1], normalised by the mean and standard deviation of each colour, at first those of ImageNet."""

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self):
        super().__init__()
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN))
        self.register_buffer("std", torch.tensor(IMAGENET_STD))

    def fit(self, images: Iterable[torch.Tensor]) -> None:
        """Take mean and standard deviation of all pixels of images uint8 (N, H, W, 3)."""
        counts = torch.zeros(3, 256, dtype=torch.float64, device=self.mean.device)
        for array in images:
            for colour in range(3):
                counts[colour] += torch.bincount(array[..., colour].flatten(), minlength=256).to(counts)
        share = counts / counts.sum(1, keepdim=True)
        levels = torch.arange(256, device=counts.device) / 255
        mean = share @ levels.double()
        self.mean.copy_(mean)
        self.std.copy_((share * (levels - mean[:, None]).square()).sum(1).sqrt().clamp(min=1 / 255))  # one grey level

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return (in_unit_range(image) - self.mean[:, None, None]) / self.std[:, None, None]


def in_unit_range(image: torch.Tensor) -> torch.Tensor:
    """Images in [-1, 1] brought to [0, 1]."""
    return (image + 1) / 2


def under_prefix(weights: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """The weights whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): tensor for name, tensor in weights.items() if name.startswith(prefix)}
