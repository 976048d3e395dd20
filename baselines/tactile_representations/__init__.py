"""Networks that are pretrained on TacRGB images; importing this package registers them as encoders of every policy."""

from . import encoder as encoder
