"""The base of tactile representations: networks over TacRGB images that take published weights or are trained here."""

from pathlib import Path

import torch
import torch.nn as nn

from baselines.common.checkpoint import load_weights, read_tensors
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError

from .released_weights import read_released

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of the colour channels in ImageNet, as torchvision documents them."""


class Representation(nn.Module):
    """Features (B, out_features) of TacRGB images (B, 3, H, W) in [-1, 1].

    Subclasses define `forward` and `convert_state_dict`.
    """

    out_features: int
    """Number of features."""
    patch: int
    """Number of pixels of which both sides of the images are a multiple."""

    def convert_state_dict(self, weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """The weights of a checkpoint that the authors released, under the names of this module."""
        raise NotImplementedError

    def load(self, path: Path) -> None:
        """Load weights that `pretrain.py` wrote (.safetensors) or that the authors released (any other suffix).

        Raises:
            CheckpointError: The file cannot be read, or belongs to another architecture.
        """
        if path.suffix == ".safetensors":
            load_weights(self, read_tensors(path), path)
        else:
            load_weights(self, self._converted(path), path)

    def _converted(self, path: Path) -> dict[str, torch.Tensor]:
        released = self.read_released(path)
        try:
            return self.convert_state_dict(released)
        except CheckpointError:
            raise
        except (LookupError, ValueError, RuntimeError) as error:  # names and shapes of any file
            raise CheckpointError(
                f"{path} holds another architecture ({type(error).__name__}: {error}); give the file that the authors released"
            ) from error

    def read_released(self, path: Path) -> dict[str, torch.Tensor]:
        """The weights that the authors released, under the authors' names."""
        return read_released(path)


class TokenRepresentation(Representation):
    """A transformer over image patches; its features are the mean of the output tokens.

    Subclasses define `embed` and `encode`.
    """

    width: int
    """Number of features of a token."""

    def embed(self, image: torch.Tensor) -> torch.Tensor:
        """Tokens (B, N, width) of an image's patches, their position embeddings added."""
        raise NotImplementedError

    def encode(self, tokens: torch.Tensor) -> torch.Tensor:
        """Output tokens (B, n, width) of any subset of the patch tokens (B, n, width), after the last layer norm."""
        raise NotImplementedError

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.encode(self.embed(image)).mean(1)


def imagenet_normalised(image: torch.Tensor) -> torch.Tensor:
    """Images in [-1, 1], normalised by the statistics of ImageNet."""
    mean, std = (torch.tensor(values, device=image.device)[:, None, None] for values in (IMAGENET_MEAN, IMAGENET_STD))
    return ((image + 1) / 2 - mean) / std


def sines_and_cosines(positions: torch.Tensor, frequencies: torch.Tensor) -> torch.Tensor:
    """Embeddings (N, 4 F) of positions (N, 2) by frequencies (2, F): for each axis the sines, then the cosines."""
    phase = positions[..., None] * frequencies
    return torch.cat([phase.sin(), phase.cos()], dim=-1).flatten(1)
