"""Pictures of touch for people: videos, reports, `render(mode="sensors")`."""

from typing import Any

import cv2
import numpy as np
import torch
from mani_skill.utils import common

NORMAL_SCALE = 0.6  # N per taxel, drawn at full brightness
SHEAR_SCALE = 0.1  # N per taxel, drawn as an arrow of one taxel pitch


def force_field_images(force_field: torch.Tensor, size: tuple[int, int] = (240, 320)) -> torch.Tensor:
    """Force fields (N, rows, cols, 3), N, as pictures uint8 (N, *size, 3): normal force as colour, shear as arrows."""
    pictures = [_draw(field, size) for field in force_field.cpu().numpy()]
    return torch.from_numpy(np.stack(pictures)).to(force_field.device)


def _draw(field: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    rows, cols = field.shape[:2]
    level = np.clip(field[..., 0] / NORMAL_SCALE, 0, 1)
    colour = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    picture = cv2.resize(np.ascontiguousarray(colour), (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
    pitch = np.array([size[0] / rows, size[1] / cols])
    for i in range(rows):
        for j in range(cols):
            arrow = np.clip(field[i, j, 1:] / SHEAR_SCALE, -2, 2) * pitch
            if np.hypot(*arrow) < 1:
                continue
            start = (np.array([i, j]) + 0.5) * pitch
            tip = start + arrow
            ends = [tuple(int(round(v)) for v in point[::-1]) for point in (start, tip)]
            cv2.arrowedLine(picture, *ends, color=(255, 90, 60), thickness=1, line_type=cv2.LINE_AA, tipLength=0.35)
    return picture


def pictures_of(obs: dict[str, Any]) -> dict[str, np.ndarray]:
    """What an observation shows of its first environment: uint8 (H, W, 3) by name, such as "wrist", "tactile right: TacFF"."""
    pictures = {}
    for sensor, data in obs["sensor_data"].items():
        title = sensor.replace("_", " ")
        if "rgb" in data:
            pictures[f"{title}: TacRGB" if sensor.startswith("tactile") else title] = common.to_numpy(data["rgb"])[0]
        if "force_field" in data:
            pictures[f"{title}: TacFF"] = common.to_numpy(force_field_images(data["force_field"]))[0]
    return pictures
