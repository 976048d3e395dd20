"""A gel-based tactile sensor (GelSight and its kin) for ManiSkill environments."""

import numpy as np
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.sensors.base_sensor import BaseSensor
from mani_skill.utils.structs import Articulation

from .config import TactileSensorConfig
from .depth.depth_camera import CameraDepth
from .depth.raycast import RaycastDepth
from .mechanics.wrench import WrenchGauge
from .touch_model import OUTPUTS, TouchModel
from .visualisation import force_field_images


class TactileSensor(BaseSensor):
    """One pad of a robot: wrench, shape of what presses, and from both a force field and an image.

    - Wrench: the force and moment that the engine carries through the pad's joint.
    - Shape: height of whatever is near the pad, by rays or by a camera in the pad.
    - Penetration: the depth and tilt at which the gel layer carries that wrench (`contact.solve_indentation`).
    - Force field: pressure of the layer, and shear by bristles with memory (`contact.solve_shear`), N per taxel.
    - RGB: the gel's surface under the compact shader (`optics`).

    Call `capture` once per control step: shear has a history.

    Args:
        config: the pad, gel, optics and taxels.
        scene: everything in it can be felt, but for the finger that carries the pad.
        articulation: the robot that has the link `config.link`.
        outputs: what `get_obs` returns, of "rgb" and "force_field"; the rest is not computed.

    Raises:
        ValueError: a link or output that does not exist.
        RuntimeError: backend "sapien" without a renderer, or for units "tacsl"; a body with an empty mesh.
    """

    config: TactileSensorConfig

    def __init__(
        self,
        config: TactileSensorConfig,
        scene: ManiSkillScene,
        articulation: Articulation,
        outputs: tuple[str, ...] = OUTPUTS,
    ):
        super().__init__(config)
        if config.link not in articulation.links_map:
            raise ValueError(
                f"link={config.link!r} of tactile sensor {config.uid!r} is not one of {sorted(articulation.links_map)}"
            )
        if unknown := set(outputs) - set(OUTPUTS):
            raise ValueError(f"outputs {sorted(unknown)} of tactile sensor {config.uid!r} are unknown; use {OUTPUTS}")
        self.scene = scene
        self.pad = articulation.links_map[config.link]
        self.model = TouchModel(config, scene.num_envs, scene.device, tuple(outputs))
        self._gauge = WrenchGauge(articulation, self.pad, config.pad_pose)
        self._depth = self._make_depth()
        self._obs: dict[str, torch.Tensor] = {}
        self.reset(torch.arange(scene.num_envs, device=scene.device))

    def _make_depth(self) -> RaycastDepth | CameraDepth:
        config = self.config
        if config.backend == "sapien":
            return CameraDepth(config, self.scene, self.pad)
        # "auto": rays are the faster ones on CPU and GPU
        return RaycastDepth(self.scene, self.pad, config.pad_pose, config.gel.size, self._unfelt_links())

    def _unfelt_links(self) -> set[str]:
        """Links that the gel cannot touch: its own finger, and what carries it as far as the robot's base."""
        names, link = set(), self.pad
        while link is not None:
            names.add(link.name)
            link = link.joint.parent_link if link.joint is not None else None
        return names

    @property
    def needs_render(self) -> bool:
        """Whether `scene.update_render` must precede `capture`."""
        return isinstance(self._depth, CameraDepth)

    def reset(self, env_idx: torch.Tensor, seeds: np.ndarray | None = None) -> None:
        """Begin an episode in these environments: no shear; noise and what is randomised as the seeds, one each, say (0)."""
        self.model.reset(env_idx, np.zeros(len(env_idx), int) if seeds is None else np.asarray(seeds))

    def wrench(self) -> torch.Tensor:
        """Force and moment (N, 6), N and N m, of the world on the pad, about the pad frame's origin, in the pad frame."""
        return self._gauge.read()

    def capture(self) -> None:
        """Sense what the scene is like now."""
        self._depth.look()
        self._obs = self.model.observe(self._depth, self.wrench())

    def get_obs(self, **kwargs) -> dict[str, torch.Tensor]:
        """What the last `capture` saw.

        `rgb` uint8 (N, 240, 320, 3). `force_field` float32 (N, 10, 14, 3), N per taxel, pad frame, of the object on the gel:
        normal (>= 0, into the gel), shear along increasing rows, shear along increasing columns. `penetration` float32
        (N, 10, 14), m. With units "tacsl", the force field is what `taxels.tacsl_field` says.
        """
        return dict(self._obs)

    def get_params(self) -> dict[str, torch.Tensor]:
        """Pad pose in the world, (N, 7), m and wxyz."""
        return dict(pose=(self.pad.pose * self.config.pad_pose).raw_pose)

    def get_images(self, obs: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Pictures for people, uint8 (N, H, W, 3), of an observation."""
        images = {}
        if "rgb" in obs:
            images["rgb"] = obs["rgb"]
        if "force_field" in obs:
            images["force_field"] = force_field_images(obs["force_field"], self.config.image_shape)
        return images
