"""The optics of the R1.5, for pads without a simulation."""

import torch

from manifeel_ms3.sensors import gelsight_r15, with_options
from manifeel_ms3.sensors.mechanics.contact import ContactGrid
from manifeel_ms3.sensors.optics.tacrgb import Optics

CONFIG = gelsight_r15("touch", "gel_right")
CPU = torch.device("cpu")
GRID = ContactGrid.covering(CONFIG.gel.size, 3.5e-4, CPU)


def background(optics: Optics) -> torch.Tensor:
    """Image (H, W, 3) of the untouched gel, uint8."""
    return (optics.levels + 0.5).clamp(0, 255).to(torch.uint8)


def make_optics(num_pads: int = 1, **fields) -> Optics:
    return Optics(with_options(CONFIG, fields), GRID, num_pads, CPU)
