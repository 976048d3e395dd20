"""What a policy sees: which observations an obs mode stands for, and how each is brought into the form a network takes.

Training reads them from files, evaluation from the environment; both go through `prepare`, so that they cannot differ.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from manifeel_ms3.tasks.obs_modes import split_obs_mode

POSE = "extra/tcp_pose"
POSE_FEATURES = 9


@dataclass(frozen=True)
class ObservationSpec:
    """Observations of a policy by their paths in ManiSkill's tree, such as "sensor_data/wrist/rgb"."""

    images: tuple[str, ...]
    """uint8 (H, W, 3): cameras and TacRGB"""
    force_fields: tuple[str, ...]
    """float32 (10, 14, 3), N"""
    image_size: int
    """images are resized to this height and width"""

    @property
    def keys(self) -> list[str]:
        return [*self.images, *self.force_fields, POSE]


def observation_spec(
    obs_mode: str, cameras: tuple[str, ...], tactile_sensors: tuple[str, ...], image_size: int
) -> ObservationSpec:
    """Observations of a policy trained with `obs_mode`; the tool's pose is always among them.

    Raises:
        ValueError: the mode holds something that a policy must not see, or that the encoders do not take.
    """
    own, touch = split_obs_mode(obs_mode)
    if own not in ("rgb", "none"):
        raise ValueError(f"obs_mode={obs_mode!r}: policies take 'rgb', 'tacrgb' and 'tacff' joined by '+', not {own!r}")
    images = [f"sensor_data/{camera}/rgb" for camera in cameras if own == "rgb"]
    images += [f"sensor_data/tactile_{side}/rgb" for side in tactile_sensors if "rgb" in touch]
    fields = [f"sensor_data/tactile_{side}/force_field" for side in tactile_sensors if "force_field" in touch]
    return ObservationSpec(tuple(images), tuple(fields), image_size)


def is_tactile(key: str) -> bool:
    return key.startswith("sensor_data/tactile_")


def prepare(key: str, value: np.ndarray, spec: ObservationSpec) -> np.ndarray:
    """One observation over time, (T, ...): images at the policy's size, poses as 9 numbers that have no jumps."""
    if key in spec.images:
        return prepare_images(value, spec.image_size)
    if key == POSE:
        return pose_features(value)
    return value.astype(np.float32)


def prepare_images(images: np.ndarray, size: int) -> np.ndarray:
    """Images (T, H, W, 3) as squares of so many pixels."""
    if images.shape[1:3] == (size, size):
        return images
    return np.stack([cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA) for image in images])


def pose_features(pose: np.ndarray) -> np.ndarray:
    """Position and first two columns of the rotation matrix (T, 9) of poses (T, 7) with wxyz quaternions.

    q and -q are one rotation and have the same features (Zhou et al. 2019, "On the continuity of rotation representations").
    """
    w, x, y, z = (pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)).T
    first = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    second = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1)
    return np.concatenate([pose[:, :3], first, second], axis=1).astype(np.float32)
