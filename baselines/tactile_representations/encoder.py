"""Tactile representations as TacRGB encoders of a policy, registered by name."""

from pathlib import Path

import torch
import torch.nn as nn

from baselines.common.encoders import PretrainedEncoder, register_tacrgb_encoder
from manifeel_ms3.errors import InvalidArgumentError

from .anytouch import AnyTouch
from .representation import Representation
from .sparsh import Sparsh
from .t3 import T3
from .unit import UniT


class RepresentationEncoder(PretrainedEncoder):
    """A tactile representation, and a linear layer to the number of features that a policy takes.

    Args:
        representation: The network.
        size: Side of the images, pixels.
        features: Number of features.

    Raises:
        InvalidArgumentError: The representation does not take images of this size.
    """

    def __init__(self, representation: Representation, size: int, features: int):
        super().__init__()
        if size % representation.patch:
            name, patch = type(representation).__name__, representation.patch
            raise InvalidArgumentError(
                f"{name} takes images whose sides are a multiple of {patch}, not {size}; give --tactile-image-size 224"
            )
        self.representation, self.frozen = representation, False
        self.out = nn.Linear(representation.out_features, features)

    def freeze(self) -> None:
        self.representation.requires_grad_(False)
        self.frozen = True

    def load(self, weights: Path) -> None:
        self.representation.load(weights)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            features = self.representation(image)
        return self.out(features)


register_tacrgb_encoder("unit", lambda size, features: RepresentationEncoder(UniT(), size, features))
register_tacrgb_encoder("unit_released", lambda size, features: RepresentationEncoder(UniT(attention=True), size, features))
register_tacrgb_encoder("t3", lambda size, features: RepresentationEncoder(T3(), size, features))
register_tacrgb_encoder("anytouch", lambda size, features: RepresentationEncoder(AnyTouch(), size, features))
register_tacrgb_encoder("sparsh", lambda size, features: RepresentationEncoder(Sparsh(), size, features))
