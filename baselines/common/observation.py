"""The observations of a policy: which ones an observation mode stands for, and the form in which networks take them.

Training reads observations from files, evaluation from the environment; both call `prepare`, so that they cannot differ.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.sensors.config import TactileSensorConfig
from manifeel_ms3.tasks.obs_modes import split_obs_mode

POSE = "extra/tcp_pose"
"""Key of the pose of the tool centre point."""
POSE_FEATURES = 9
"""Numbers by which networks know the pose: position and two columns of the rotation matrix (`pose_features`)."""
TAXEL_SHAPE = TactileSensorConfig.taxel_shape
"""Rows and columns of taxels of the default sensor."""


@dataclass(frozen=True)
class ObservationSpec:
    """Observations of a policy by their paths in ManiSkill's tree, such as "sensor_data/wrist/rgb"."""

    images: tuple[str, ...]
    """Cameras and TacRGB, uint8 (H, W, 3)."""
    force_fields: tuple[str, ...]
    """TacFF force fields, float32 (*taxel_shape, 3), N."""
    image_size: int
    """Height and width to which images are resized, pixels."""
    taxel_shape: tuple[int, int] = TAXEL_SHAPE
    """Rows and columns of taxels in a force field."""

    @property
    def keys(self) -> list[str]:
        """All observations."""
        return [*self.images, *self.force_fields, POSE]


def observation_spec(
    obs_mode: str,
    cameras: tuple[str, ...],
    tactile_sensors: tuple[str, ...],
    image_size: int,
    taxel_shape: tuple[int, int] = TAXEL_SHAPE,
) -> ObservationSpec:
    """Observations of a policy that is trained with an observation mode; the tool pose is always among them.

    Args:
        obs_mode: Modalities, such as "rgb+tacff".
        cameras: Names of the cameras.
        tactile_sensors: Sides of the tactile sensors, "left" or "right".
        image_size: Height and width to which images are resized, pixels.
        taxel_shape: Rows and columns of taxels in a force field.

    Raises:
        InvalidArgumentError: The mode holds privileged observations, or some that the encoders do not take.
    """
    own, touch = split_obs_mode(obs_mode)
    if own not in ("rgb", "none"):
        raise InvalidArgumentError(
            f"obs_mode={obs_mode!r}: policies take 'rgb', 'tacrgb' and 'tacff' joined by '+', not {own!r}"
        )
    images = [f"sensor_data/{camera}/rgb" for camera in cameras if own == "rgb"]
    images += [f"sensor_data/tactile_{side}/rgb" for side in tactile_sensors if "rgb" in touch]
    fields = [f"sensor_data/tactile_{side}/force_field" for side in tactile_sensors if "force_field" in touch]
    return ObservationSpec(tuple(images), tuple(fields), image_size, taxel_shape)


def is_tactile(key: str) -> bool:
    """Whether an observation is a tactile sensor's."""
    return key.startswith("sensor_data/tactile_")


def prepare(key: str, value: np.ndarray, spec: ObservationSpec) -> np.ndarray:
    """One observation over time, (T, ...), as networks take it: images resized, poses as nine continuous numbers."""
    if key in spec.images:
        return prepare_images(value, spec.image_size)
    if key == POSE:
        return pose_features(value)
    return value.astype(np.float32)


def prepare_images(images: np.ndarray, size: int) -> np.ndarray:
    """Images (T, H, W, 3) resized to squares of `size` pixels."""
    if images.shape[1:3] == (size, size):
        return images
    return np.stack([cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA) for image in images])


def pose_features(pose: np.ndarray) -> np.ndarray:
    """Position and first two columns of the rotation matrix, (T, 9), of poses (T, 7) with wxyz quaternions.

    The quaternions q and -q are one rotation and have the same features (Zhou et al. 2019, "On the Continuity of Rotation
    Representations in Neural Networks").
    """
    w, x, y, z = (pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)).T
    first = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    second = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1)
    return np.concatenate([pose[:, :3], first, second], axis=1).astype(np.float32)
