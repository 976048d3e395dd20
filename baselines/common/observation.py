"""The observations of a policy: which ones an observation mode stands for, and the form in which networks take them.

Training reads observations from files, evaluation from the environment; both call `prepare`, so that they cannot differ.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.sensors.config import TactileSensorConfig
from manifeel_ms3.tasks.obs_modes import PAD, POSE, split_obs_mode

PoseForm = Literal["quaternion", "rotation_6d"]
"""Forms in which networks take the pose: its position with a quaternion, or with two columns of the rotation matrix."""
POSE_FEATURES: dict[PoseForm, int] = {"quaternion": 7, "rotation_6d": 9}
"""Number of features of a pose, by its form."""
MIDDLE_QUATERNION = np.array([0.0, np.cos(np.pi / 8), np.sin(np.pi / 8), 0.0])
"""Quaternion (wxyz) of the hand pointing down with its wrist joint in the middle of its range, which is a yaw of 45 degrees."""
MIN_IMAGE_SIZE, MAX_IMAGE_SIZE = 16, 2048
"""Smallest and largest side of an image that policies take, pixels; set once, not tuned. Without the second, the config of a
stranger's checkpoint could ask for images that fill the memory."""
TAXEL_SHAPE = TactileSensorConfig.taxel_shape
"""Rows and columns of taxels of the default sensor."""
CameraView = Literal["whole", "work"]
"""Parts of a camera image that networks take: all of it, or the square in which the work is done."""
WORK_SQUARES = dict(wrist=(0.28, 0.14, 0.72), front=(0.0, 0.125, 0.75), side=(0.0, 0.125, 0.75))
"""Top, left and side of the square of each camera's image in which the work is done, as shares of its side. Outside
of it the wrist camera sees its own housing, and the others see bare table (judged by eye in demonstrations of all tasks)."""


class ImageSizeError(InvalidArgumentError):
    """A network does not take images of this size; the message ends with the options that set one which it takes."""


@dataclass(frozen=True)
class ObservationSpec:
    """Observations of a policy by their paths in ManiSkill's tree, such as "sensor_data/wrist/rgb"."""

    images: tuple[str, ...]
    """Cameras and TacRGB, uint8 (H, W, 3)."""
    force_fields: tuple[str, ...]
    """TacFF force fields, float32 (*taxel_shape, 3), N."""
    image_size: int
    """Height and width to which camera images are resized, pixels."""
    tactile_image_size: int
    """Height and width to which TacRGB images are resized, pixels."""
    taxel_shape: tuple[int, int] = TAXEL_SHAPE
    """Rows and columns of taxels in a force field."""
    pose: PoseForm = "quaternion"
    """Form of the tool's pose."""
    camera_view: CameraView = "whole"
    """Part of the camera images that networks take."""

    @property
    def keys(self) -> list[str]:
        """All observations."""
        return [*self.images, *self.force_fields, POSE]

    @property
    def pose_features(self) -> int:
        """Number of features of the tool's pose."""
        return POSE_FEATURES[self.pose]

    def size_of(self, key: str) -> int:
        """Height and width of an image, pixels."""
        return self.tactile_image_size if is_tactile(key) else self.image_size


def observation_spec(
    obs_mode: str,
    cameras: tuple[str, ...],
    tactile_sensors: tuple[str, ...],
    image_size: int,
    tactile_image_size: int | None = None,
    taxel_shape: tuple[int, int] = TAXEL_SHAPE,
    pose: PoseForm = "quaternion",
    camera_view: CameraView = "whole",
) -> ObservationSpec:
    """Observations of a policy that is trained with an observation mode; the tool pose is always among them.

    Args:
        obs_mode: Modalities, such as "rgb+tacff".
        cameras: Names of the cameras.
        tactile_sensors: Sides of the tactile sensors, "left" or "right".
        image_size: Height and width to which camera images are resized, pixels.
        tactile_image_size: Height and width to which TacRGB images are resized, pixels; those of the cameras if not given.
        taxel_shape: Rows and columns of taxels in a force field.
        pose: Form of the tool's pose.
        camera_view: Part of the camera images that networks take.

    Raises:
        InvalidArgumentError: The mode holds privileged observations, or some that the encoders do not take, or a size, the form
            of the pose or the part of the images is not allowed.
    """
    if tactile_image_size is None:
        tactile_image_size = image_size
    for name, size in (("image_size", image_size), ("tactile_image_size", tactile_image_size)):
        if size < MIN_IMAGE_SIZE:
            raise InvalidArgumentError(
                f"{name}={size}: images need at least {MIN_IMAGE_SIZE} pixels on each side; the paper's have 256"
            )
        if size > MAX_IMAGE_SIZE:
            raise InvalidArgumentError(f"{name}={size}: images have at most {MAX_IMAGE_SIZE} pixels on each side")
    if pose not in get_args(PoseForm):
        raise InvalidArgumentError(f"pose={pose!r}: the forms of a pose are {list(get_args(PoseForm))}")
    if camera_view not in get_args(CameraView):
        raise InvalidArgumentError(f"camera_view={camera_view!r}: the parts of an image are {list(get_args(CameraView))}")
    own, touch = split_obs_mode(obs_mode)
    if own not in ("rgb", "none"):
        raise InvalidArgumentError(
            f"obs_mode={obs_mode!r}: policies take 'rgb', 'tacrgb' and 'tacff' joined by '+', not {own!r}"
        )
    images = [f"sensor_data/{camera}/rgb" for camera in cameras if own == "rgb"]
    images += [f"sensor_data/tactile_{side}/rgb" for side in tactile_sensors if "rgb" in touch]
    fields = [f"sensor_data/tactile_{side}/force_field" for side in tactile_sensors if "force_field" in touch]
    return ObservationSpec(tuple(images), tuple(fields), image_size, tactile_image_size, taxel_shape, pose, camera_view)


def is_tactile(key: str) -> bool:
    """Whether an observation comes from a tactile sensor."""
    return key.startswith(f"sensor_data/{PAD}")


def prepare(key: str, value: np.ndarray, spec: ObservationSpec) -> np.ndarray:
    """One observation over time, (T, ...), as networks take it: images resized, poses in the form that the policy takes."""
    if key in spec.images:
        if spec.camera_view == "work" and not is_tactile(key):
            value = work_square(value, key.split("/")[1])
        return prepare_images(value, spec.size_of(key))
    if key == POSE:
        return rotation_6d_pose(value) if spec.pose == "rotation_6d" else quaternion_pose(value)
    return value.astype(np.float32)


def work_square(images: np.ndarray, camera: str) -> np.ndarray:
    """The square of a camera's images (T, H, W, 3) in which the work is done; images of other cameras are returned whole.

    The square is that of the largest square in the middle of an image, as if a wide or tall image were cut to it.
    """
    if camera not in WORK_SQUARES:
        return images
    height, width = images.shape[1:3]
    whole = min(height, width)
    top, left, side = (round(share * whole) for share in WORK_SQUARES[camera])
    top, left = top + (height - whole) // 2, left + (width - whole) // 2
    return images[:, top : top + side, left : left + side]


def prepare_images(images: np.ndarray, size: int) -> np.ndarray:
    """Images (T, H, W, 3) resized to squares of `size` pixels."""
    if images.shape[1:3] == (size, size):
        return np.ascontiguousarray(images)  # a part of larger images would keep them in memory
    return np.stack([cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA) for image in images])


def quaternion_pose(pose: np.ndarray) -> np.ndarray:
    """Poses (T, 7) with unit wxyz quaternions, of which q and -q, the same rotation, have the same sign.

    The sign is that of the smaller angle to `MIDDLE_QUATERNION`. It changes half a turn away from there; a hand that points
    down does not come there, because its wrist joint ends 166 degrees to either side of the middle (Franka's data sheet).
    """
    quaternion = pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    sign = np.where(quaternion @ MIDDLE_QUATERNION < 0, -1.0, 1.0)
    return np.concatenate([pose[:, :3], sign[:, None] * quaternion], axis=1).astype(np.float32)


def rotation_6d_pose(pose: np.ndarray) -> np.ndarray:
    """Position and first two columns of the rotation matrix, (T, 9), of poses (T, 7) with wxyz quaternions.

    Unlike quaternions, the columns are a continuous function of the rotation everywhere (Zhou et al. 2019, "On the Continuity
    of Rotation Representations in Neural Networks").
    """
    w, x, y, z = (pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)).T
    first = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    second = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1)
    return np.concatenate([pose[:, :3], first, second], axis=1).astype(np.float32)
