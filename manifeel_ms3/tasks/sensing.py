"""Observation with cameras and tactile pads."""

# pyright: reportArgumentType=false, reportCallIssue=false
# (ManiSkill annotates images as arrays of any library, and sensors by their base class)
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.observations import sensor_data_to_pointcloud
from mani_skill.sensors.camera import Camera
from mani_skill.utils import common

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.sensors import TactileSensor, TactileSensorConfig

from .images import same_height, tiled


class SensingEnv(BaseEnv):
    """A ManiSkill environment whose observations and images hold those of tactile pads, too.

    Subclasses set `_tactile_outputs` and `_tactile_configs` before they call the constructor, and set `_touch_is_stale` in each
    environment whose state changes.
    """

    _tactile_outputs: tuple[str, ...]
    """Outputs of the pads that observations hold: "rgb", "force_field"."""
    _tactile_configs: dict[str, TactileSensorConfig]
    """Configurations of the observed pads by sensor name."""
    _touch_is_stale: torch.Tensor
    """Whether the pads of each environment, (N,) bool, are still to be read in the present state. They are read once per state,
    since shear has a history."""
    _observes = True
    """Whether `get_obs` observes anything."""
    renders_cameras = True
    """Whether observations hold the cameras' images. They are left out where a policy does not use them, to save time."""

    def _make_tactile_sensors(self) -> None:
        # not called from _setup_sensors, which runs only with a renderer: touch works without one
        self._tactile_sensors = {
            uid: TactileSensor(config, self.scene, self.agent.robot, self._tactile_outputs)
            for uid, config in self._tactile_configs.items()
            if self._tactile_outputs
        }
        self._touch_is_stale = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)

    def _drawn_imperfections(self) -> dict[str, dict[str, dict[str, torch.Tensor]]]:
        """Entry "imperfections" of `info`: what the episodes drew, by pad and name; none for perfect sensors."""
        drawn = {name: sensor.drawn_imperfections for name, sensor in self._tactile_sensors.items()}
        return dict(imperfections=drawn) if any(drawn.values()) else {}

    @contextmanager
    def _nothing_observed(self) -> Iterator[None]:
        """Let `get_obs` return an empty observation in this context, and spare its time."""
        self._observes = False
        try:
            yield
        finally:
            self._observes = True

    def get_obs(self, info: dict | None = None, unflattened: bool = False):
        if not self._observes:
            return {}
        if not self._tactile_outputs:
            return super().get_obs(info, unflattened)
        obs = self._get_obs_with_sensor_data(self.get_info() if info is None else info)
        if self._obs_mode == "pointcloud":
            obs = sensor_data_to_pointcloud(obs, self._sensors)
        return obs if unflattened else self._flatten_raw_obs(obs)

    def _flatten_raw_obs(self, obs: Any):
        if self._tactile_outputs and self.obs_mode_struct.state:  # ManiSkill would make touch a part of the state vector
            tree = dict(agent=obs["agent"], extra=obs["extra"])
            state = common.flatten_state_dict(tree, use_torch=True, device=self.device)
            return {name: data for name, data in obs.items() if name not in tree} | dict(state=state)
        return super()._flatten_raw_obs(obs)

    def _get_obs_sensor_data(self, apply_texture_transforms: bool = True) -> dict:
        visual = self.obs_mode_struct.visual
        return self._sense({name: getattr(visual, name) for name in visual.__dict__}, apply_texture_transforms)

    def _sense(self, textures: dict[str, bool], apply_texture_transforms: bool = True) -> dict:
        """Observations of the cameras (these textures) and the pads in the present state; nothing else is rendered."""
        wanted = self.renders_cameras and any(textures.values())
        cameras = {name: s for name, s in self._sensors.items() if isinstance(s, Camera)} if wanted else {}
        if cameras or any(sensor.needs_render for sensor in self._tactile_sensors.values()):
            self.scene.update_render(update_sensors=True, update_human_render_cameras=False)
        for camera in cameras.values():
            camera.capture()
        self._read_pads()  # while the renderer draws: `get_obs` waits until the images are there
        observed = {
            name: self._on_device(camera.get_obs(**textures, apply_texture_transforms=apply_texture_transforms))
            for name, camera in cameras.items()
        }
        return observed | {name: sensor.get_obs() for name, sensor in self._tactile_sensors.items()}

    def _on_device(self, images: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """The images on the environment's device, copied from a GPU's buffers, in which the next images will be drawn."""
        return {name: image.to(self.device, copy=image.is_cuda) for name, image in images.items()}

    def _read_pads(self) -> None:
        """Read the pads whose readings are stale, and no others."""
        env_idx = self._touch_is_stale.nonzero()[:, 0]
        if len(env_idx) == 0:
            return
        for sensor in self._tactile_sensors.values():
            sensor.capture(None if len(env_idx) == self.num_envs else env_idx)
        self._touch_is_stale[:] = False

    def get_sensor_images(self) -> dict[str, dict[str, torch.Tensor]]:
        """Images of every camera and pad in the present state, uint8 (N, H, W, 3) each."""
        observed = self._sense(dict(rgb=True, depth=False, position=False, segmentation=False))
        sensors = self._sensors | self._tactile_sensors
        return {name: sensors[name].get_images(data) for name, data in observed.items()}

    def get_sensor_params(self) -> dict[str, dict[str, torch.Tensor]]:
        visual = any(vars(self.obs_mode_struct.visual).values())
        cameras = super().get_sensor_params() if visual else {}
        return cameras | {name: sensor.get_params() for name, sensor in self._tactile_sensors.items()}

    @property
    def touch_full_scales(self) -> dict[str, float]:
        """Full scale of the force field of each observed pad by name, N or m, which pictures draw at full brightness."""
        return {name: config.full_scale for name, config in self._tactile_configs.items()}

    def render_sensors(self):
        images = self._all_sensor_images()
        if not images:
            raise InvalidArgumentError(
                "render_mode='sensors' shows the observed cameras and pads, but there are none; name some in `cameras`, or in "
                "`tactile_sensors` with an obs_mode that has touch"
            )
        return tiled(images)

    def render_all(self):
        images = self._all_sensor_images()
        sensors = [tiled(images)] if images else []
        return torch.cat(same_height([self.render_rgb_array(), *sensors]), dim=2)

    def _all_sensor_images(self) -> list[torch.Tensor]:
        """Images of all cameras and pads, uint8 (N, H, W, 3) each; none where nothing is observed, as in a file of states."""
        return [image for sensor in self.get_sensor_images().values() for image in sensor.values()]

    def print_sim_details(self):
        super().print_sim_details()
        for name, config in self._tactile_configs.items():
            if self._tactile_outputs:
                pixels, taxels = (" x ".join(map(str, shape)) for shape in (config.image_shape, config.taxel_shape))
                observed = dict(rgb=f"TacRGB {pixels} pixels", force_field=f"TacFF {taxels} taxels")
                print(f"{name}: {', '.join(observed[output] for output in self._tactile_outputs)}")  # noqa: T201
