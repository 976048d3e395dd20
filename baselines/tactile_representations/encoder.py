"""Tactile representations as TacRGB encoders of a policy, registered by name."""

from collections.abc import Iterable
from pathlib import Path

import torch

from baselines.common.encoders import PretrainedEncoder, register_tacrgb_encoder
from baselines.common.observation import ImageSizeError

from .anytouch import AnyTouch
from .representation import Representation
from .sparsh import Sparsh
from .t3 import T3
from .unit import UniT


class RepresentationEncoder(PretrainedEncoder):
    """A tactile representation, and its head: layers from the representation to the features that a policy takes.

    Args:
        representation: The network.
        size: Side of the images, pixels.
        features: Number of features.

    Raises:
        ImageSizeError: The representation does not take images of this size.
    """

    def __init__(self, representation: Representation, size: int, features: int):
        super().__init__()
        require_size(representation, size)
        self.representation, self.frozen = representation, False
        self.out = representation.head(features)
        for part in representation.unused_parts():
            part.requires_grad_(False)

    def freeze(self) -> None:
        self.representation.requires_grad_(False)
        self.frozen = True

    def choose_sensor(self, name: str) -> None:
        self.representation.choose_sensor(name)

    def load(self, weights: Path) -> None:
        self.representation.load(weights)

    def fit(self, images: Iterable[torch.Tensor]) -> None:
        self.representation.fit(images)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            output = self.representation(image)
        return self.out(output)


def require_size(representation: Representation, size: int, option: str = "--tactile-image-size") -> None:
    """Check that a representation takes square images of a size.

    Args:
        representation: The network.
        size: Side of the images, pixels.
        option: Option of the command line that sets the size, for the error's message.

    Raises:
        ImageSizeError: The representation does not take images of this size.
    """
    patch = representation.patch
    if size < patch or size % patch:
        raise ImageSizeError(
            f"{type(representation).__name__} takes images whose sides are a multiple of {patch}, not {size}; give {option} "
            f"{representation.size}"
        )


register_tacrgb_encoder("unit", lambda size, features: RepresentationEncoder(UniT(), size, features))
register_tacrgb_encoder("unit_released", lambda size, features: RepresentationEncoder(UniT(attention=True), size, features))
register_tacrgb_encoder("t3", lambda size, features: RepresentationEncoder(T3(), size, features))
register_tacrgb_encoder("anytouch", lambda size, features: RepresentationEncoder(AnyTouch(), size, features))
register_tacrgb_encoder("sparsh", lambda size, features: RepresentationEncoder(Sparsh(), size, features))
