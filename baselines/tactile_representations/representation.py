"""What tactile representations share: they look at TacRGB, take published weights, and can be trained on pictures alone."""

from pathlib import Path

import torch
import torch.nn as nn

from baselines.common.checkpoint import load_weights, read_tensors
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Representation(nn.Module):
    """Features (B, out_features) of TacRGB pictures (B, 3, H, W) in [-1, 1].

    Subclasses define `forward` and `published`; `patch`: the sides of its pictures are a multiple of it, pixels.
    """

    out_features: int
    patch: int

    def published(self, weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Our names for the weights of a checkpoint that its authors released."""
        raise NotImplementedError

    def load(self, path: Path) -> None:
        """Load weights of ours (.safetensors) or of the authors.

        Raises:
            CheckpointError: the file cannot be read, or is of something else.
        """
        if path.suffix == ".safetensors":
            load_weights(self, read_tensors(path), path)
        else:
            load_weights(self, self.published(self.read_published(path)), path)

    def read_published(self, path: Path) -> dict[str, torch.Tensor]:
        """The authors' weights by their names for them."""
        return read_pickled(path)


class TokenRepresentation(Representation):
    """A transformer over patches: its features are the mean of what it makes of them.

    Subclasses define `embed` and `encode`.
    """

    width: int

    def embed(self, image: torch.Tensor) -> torch.Tensor:
        """Patches with their places (B, N, width)."""
        raise NotImplementedError

    def encode(self, tokens: torch.Tensor) -> torch.Tensor:
        """Any of those patches (B, n, width) through all layers, the last norm included: (B, n, width)."""
        raise NotImplementedError

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.encode(self.embed(image)).mean(1)


def read_pickled(path: Path) -> dict[str, torch.Tensor]:
    """Tensors of a .pth or .ckpt file; nothing else in it is loaded, and nothing run."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many
        raise CheckpointError(f"{path} cannot be read as weights ({error}); give the file that the authors released") from error
    for key in ("model", "state_dict"):
        content = content.get(key, content)
    return {name: tensor for name, tensor in content.items() if isinstance(tensor, torch.Tensor)}


def imagenet_normalised(image: torch.Tensor) -> torch.Tensor:
    """Pictures in [-1, 1] as networks trained on ImageNet's statistics want them."""
    mean, std = (torch.tensor(values, device=image.device)[:, None, None] for values in (IMAGENET_MEAN, IMAGENET_STD))
    return ((image + 1) / 2 - mean) / std


def sines_and_cosines(positions: torch.Tensor, frequencies: torch.Tensor) -> torch.Tensor:
    """(N, 4 F) of positions (N, 2) and frequencies (2, F): sines, then cosines, axis by axis."""
    phase = positions[..., None] * frequencies
    return torch.cat([phase.sin(), phase.cos()], dim=-1).flatten(1)
