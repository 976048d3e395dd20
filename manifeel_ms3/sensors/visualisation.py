"""Images of touch for people: videos, reports, `render(mode="sensors")`."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import torch
from mani_skill.utils import common

SHEAR_SHARE = 0.1 / 0.6  # share of the full scale that is drawn as an arrow as long as the taxels' pitch (chosen: 0.1 N)
MAX_ARROW = 2  # taxel pitches: length along each axis at which arrows are cut (chosen)
MIN_ARROW = 1  # pixels: shorter arrows are not drawn
ARROW_COLOUR = (255, 90, 60)  # RGB, chosen by eye
ARROW_HEAD = 0.35  # share of the arrow's length, chosen by eye


def force_field_images(force_field: torch.Tensor, full_scale: float, size: tuple[int, int] = (240, 320)) -> torch.Tensor:
    """Images uint8 (N, *size, 3) of force fields: the normal component as colour, shear as arrows.

    Args:
        force_field: Force fields (N, rows, cols, 3), in the unit of the sensor.
        full_scale: Normal component that is drawn at full brightness, in the same unit (`TactileSensorConfig.full_scale`).
        size: Height and width of the images, in pixels.
    """
    images = [_draw(field, full_scale, size) for field in force_field.cpu().numpy()]
    return torch.from_numpy(np.stack(images)).to(force_field.device)


def _draw(field: np.ndarray, full_scale: float, size: tuple[int, int]) -> np.ndarray:
    rows, cols = field.shape[:2]
    level = np.clip(field[..., 0] / full_scale, 0, 1)
    colour = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    image = cv2.resize(np.ascontiguousarray(colour), (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
    pitch = np.array([size[0] / rows, size[1] / cols])
    for i, j in np.ndindex(rows, cols):
        arrow = np.clip(field[i, j, 1:] / (full_scale * SHEAR_SHARE), -MAX_ARROW, MAX_ARROW) * pitch
        if np.hypot(*arrow) < MIN_ARROW:
            continue
        start = (np.array([i, j]) + 0.5) * pitch
        ends = [tuple(np.rint(point[::-1]).astype(int).tolist()) for point in (start, start + arrow)]
        cv2.arrowedLine(image, *ends, color=ARROW_COLOUR, thickness=1, line_type=cv2.LINE_AA, tipLength=ARROW_HEAD)
    return image


def observation_images(obs: dict[str, Any], full_scales: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Images uint8 (H, W, 3) in an observation's first environment, by title, such as "wrist" or "tactile right: TacFF".

    Args:
        obs: Observation of an environment with cameras and pads.
        full_scales: Full scales of the pads by name, the environment's `touch_full_scales`.
    """
    images = {}
    for sensor, data in obs["sensor_data"].items():
        title = sensor.replace("_", " ")
        if "rgb" in data:
            images[f"{title}: TacRGB" if sensor.startswith("tactile") else title] = common.to_numpy(data["rgb"][0])
        if "force_field" in data:
            images[f"{title}: TacFF"] = force_field_images(data["force_field"][:1], full_scales[sensor])[0].numpy()
    return images
