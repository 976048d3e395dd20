"""The optics of the R1.5, for pads without a simulation."""

import cv2
import numpy as np
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


def dots(image: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Middles (n, 2), as column and row, and areas (n,) of the dark dots of an image, in pixels."""
    _, _, stats, centres = cv2.connectedComponentsWithStats((image.numpy().astype(int).sum(-1) < 180).astype(np.uint8))
    return centres[1:], stats[1:, cv2.CC_STAT_AREA]
