"""Wrappers that give visuotactile observations the forms that ManiSkill's scripts and wrappers expect."""

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import common
from torch.nn.functional import interpolate

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.tasks.obs_modes import PAD

Observation = dict[str, Any]


class _ObservationWrapper(gym.ObservationWrapper):
    """An observation wrapper that tells the environment its new observation space, as ManiSkill's wrappers do."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        raw: Any = self.base_env._init_raw_obs  # on the CPU, unlike those that follow it
        first = common.to_tensor(raw, self.base_env.device)
        self.base_env.update_obs_space(common.to_cpu_tensor(self.observation(first)))

    @property
    def base_env(self) -> BaseEnv:
        """The environment without its wrappers."""
        return self.env.unwrapped  # pyright: ignore[reportReturnType]

    def _sensors(self, observation: Any) -> tuple[Observation, Observation]:
        """Observations of the cameras and of the pads, by sensor."""
        if not isinstance(observation, dict) or "sensor_data" not in observation:
            mode = getattr(self.base_env, "obs_mode", None)
            raise InvalidArgumentError(
                f"{type(self).__name__} takes observations with sensors, such as obs_mode='rgb+tacff' or 'state+tacff'; this "
                f"environment has obs_mode={mode!r}"
            )
        sensors = observation["sensor_data"]
        pads = {name: data for name, data in sensors.items() if name.startswith(PAD)}
        return {name: data for name, data in sensors.items() if name not in pads}, pads


class FlattenVisuotactileObservationWrapper(_ObservationWrapper):
    """ManiSkill's `FlattenRGBDObservationWrapper` with touch: an observation is a dict with one entry for each modality.

    - `state` (N, D): everything that no sensor observes, such as joint positions and the tool's pose.
    - `rgb` uint8 (N, H, W, 3 C) and `depth` (N, H, W, C): images of the C cameras.
    - `tacrgb` uint8 (N, H, W, 3 P): images of the P pads.
    - `tacff` float32 (N, 10, 14, 3 P): force fields of the pads, N per taxel.

    An entry is absent if the observation mode does not ask for it.

    Args:
        env: Environment whose observation mode has sensors.
        rgb: Whether images of cameras are included.
        depth: Whether depth images are included.
        state: Whether the state is included.
        tacrgb: Whether images of pads are included.
        tacff: Whether force fields are included.
        image_size: Height and width to which `rgb` and `tacrgb` are resized, in pixels; they keep their own size if not given.
        sep_tacrgb: Whether `tacrgb` is an entry of its own. If not, its channels follow those of `rgb`, for scripts that only
            know cameras; all images must then have one size.
        flat_tacff: Whether `tacff` is a vector (N, 420 P), so that ManiSkill's `FlattenObservationWrapper` can join it with the
            state.

    Raises:
        InvalidArgumentError: The observation mode has no sensors or a pointcloud, or images to be joined have different sizes.
    """

    def __init__(
        self,
        env: gym.Env,
        rgb: bool = True,
        depth: bool = True,
        state: bool = True,
        tacrgb: bool = True,
        tacff: bool = True,
        image_size: int | None = None,
        sep_tacrgb: bool = True,
        flat_tacff: bool = False,
    ):
        self._included = dict(state=state, rgb=rgb, depth=depth, tacrgb=tacrgb, tacff=tacff)
        self._image_size, self._sep_tacrgb, self._flat_tacff = image_size, sep_tacrgb, flat_tacff
        super().__init__(env)

    def observation(self, observation: Any) -> Observation:
        cameras, pads = self._sensors(observation)
        if "pointcloud" in observation:
            raise InvalidArgumentError("a pointcloud cannot be flattened; join other textures, such as 'rgb+depth', with touch")
        rest = {name: data for name, data in observation.items() if name not in ("sensor_data", "sensor_param")}
        parts: Mapping[str, Callable[[], Any]] = dict(
            state=lambda: common.flatten_state_dict(rest, use_torch=True, device=self.base_env.device),
            rgb=lambda: self._images(cameras),
            depth=lambda: _joined(cameras, "depth", "leave depth out, or give the cameras one size"),
            tacrgb=lambda: self._images(pads),
            tacff=lambda: _joined(pads, "force_field", "give the pads one number of taxels"),
        )
        included = {name: part() for name, part in parts.items() if self._included[name]}
        flat: Observation = {name: data for name, data in included.items() if data is not None}
        if self._flat_tacff and "tacff" in flat:
            flat["tacff"] = flat["tacff"].flatten(1)
        if not self._sep_tacrgb and "tacrgb" in flat:
            images = [flat[name] for name in ("rgb", "tacrgb") if name in flat]
            flat["rgb"] = _channels(images, "images of cameras and TacRGB")
            del flat["tacrgb"]
        return flat

    def _images(self, sensors: Observation) -> torch.Tensor | None:
        images = [data["rgb"] for data in sensors.values() if "rgb" in data]
        if self._image_size is not None:
            images = [resized(image, (self._image_size, self._image_size)) for image in images]
        return _channels(images, f"images of {list(sensors)}") if images else None


class PadsAsCamerasWrapper(_ObservationWrapper):
    """Observations in which every sensor is a camera, to be wrapped by ManiSkill's own wrappers.

    The image of a pad has the size of the cameras' images, so that their channels can be joined. Its force field is a vector
    (N, 420) in `extra`, which those wrappers make a part of the state, or in `state` if the observation has that.

        FlattenRGBDObservationWrapper(PadsAsCamerasWrapper(gym.make("ManiFeel-PegInsertion-v1", obs_mode="rgb+tacff")))

    Args:
        env: Environment whose observation mode has sensors.

    Raises:
        InvalidArgumentError: The observation mode has no sensors, or asks for images of pads and for textures that pads lack.
    """

    def observation(self, observation: Any) -> Observation:
        cameras, pads = self._sensors(observation)
        textures = {name for data in cameras.values() for name in data}
        if pads_with_images := {name: data for name, data in pads.items() if "rgb" in data and textures != {"rgb"} and cameras}:
            raise InvalidArgumentError(
                f"the pads {list(pads_with_images)} have rgb alone, the cameras {sorted(textures)}; leave 'tacrgb' out of the "
                "obs_mode, or use FlattenVisuotactileObservationWrapper"
            )
        size = next((data["rgb"].shape[1:3] for data in cameras.values() if "rgb" in data), None)
        images = {name: dict(rgb=resized(data["rgb"], size)) for name, data in pads.items() if "rgb" in data}
        fields = {f"{name}_force_field": data["force_field"].flatten(1) for name, data in pads.items() if "force_field" in data}
        kept = {name: data for name, data in observation.items() if name not in ("sensor_data", "sensor_param", "extra")}
        if "state" in observation:
            kept["state"] = torch.cat([observation["state"], *fields.values()], dim=1)
        else:
            kept["extra"] = observation["extra"] | fields
        if not cameras and not images:
            return kept
        params = {name: data for name, data in observation["sensor_param"].items() if name in cameras}
        return kept | dict(sensor_param=params, sensor_data=cameras | images)


def resized(images: torch.Tensor, size: tuple[int, int] | None) -> torch.Tensor:
    """Images (N, H, W, C) at another height and width, without aliasing; unchanged if no size is given."""
    if size is None or images.shape[1:3] == tuple(size):
        return images
    channels_first = images.permute(0, 3, 1, 2).float()
    smaller = interpolate(channels_first, size=tuple(size), mode="bilinear", antialias=True).permute(0, 2, 3, 1)
    return smaller.round().to(images.dtype) if images.dtype == torch.uint8 else smaller.to(images.dtype)


def _joined(sensors: Observation, kind: str, mend: str) -> torch.Tensor | None:
    """What each sensor observes of one kind, joined along channels; None if no sensor has it."""
    found = [data[kind] for data in sensors.values() if kind in data]
    return _channels(found, f"{kind} of {list(sensors)}", mend) if found else None


def _channels(images: list[torch.Tensor], what: str, mend: str = "give image_size, such as 128") -> torch.Tensor:
    sizes = {tuple(image.shape[1:3]) for image in images}
    if len(sizes) > 1:
        raise InvalidArgumentError(f"{what} have the sizes {sorted(sizes)} and cannot be joined; {mend}")
    return torch.cat(images, dim=-1)
