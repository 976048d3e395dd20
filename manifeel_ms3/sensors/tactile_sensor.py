"""Gel-based tactile sensor (GelSight and similar ones) for ManiSkill environments."""

import logging

import numpy as np
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.sensors.base_sensor import BaseSensor
from mani_skill.utils.structs import Articulation

from manifeel_ms3.errors import UnknownNameError

from .config import TactileSensorConfig
from .depth.depth_camera import CameraDepth
from .depth.raycast import RaycastDepth
from .draws import pad_seeds
from .mechanics.wrench import WrenchGauge
from .touch_model import OUTPUTS, TouchModel
from .visualisation import force_field_images

log = logging.getLogger(__name__)
CLEAR_FORCE = 1.0
"""Pull or push on a gel, in N, that shows which way it faces: more than the inertia of a pad, less than a grip (chosen)."""


class TactileSensor(BaseSensor):
    """One pad of a robot: a force field and an image from the measured wrench and the shape of what presses.

    - Wrench: the force and moment that the engine carries through the pad's joint.
    - Shape: the height of everything near the pad, by rays or by a camera in the pad.
    - Penetration: the depth and tilt at which the gel layer carries that wrench (`contact.solve_indentation`).
    - Force field: the layer's normal force, and shear by bristles with memory (`contact.solve_shear`), N per taxel.
    - RGB: the gel's surface under the compact shader (`optics.tacrgb`).

    Call `capture` exactly once per control step, since shear has a history; at a reset, for the environments that are reset.

    Args:
        config: Configuration of the pad, gel, optics and taxels.
        scene: Scene that contains the robot; everything in it can be felt, except the finger that carries the pad.
        articulation: Robot that has the link `config.link`.
        outputs: Outputs of `get_obs`, of "rgb" and "force_field"; the rest is not computed.

    Raises:
        UnknownNameError: The link or an output does not exist.
        InvalidArgumentError: Backend "sapien" is combined with units "tacsl", or a body has a shape that has no mesh.
        InvalidFileError: A body has a mesh without triangles.
        MachineError: Backend "sapien" needs a renderer, and the scene has none.
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
            known = sorted(articulation.links_map)
            raise UnknownNameError(f"link={config.link!r} of tactile sensor {config.uid!r} does not exist; choose from {known}")
        if unknown := set(outputs) - set(OUTPUTS):
            raise UnknownNameError(f"outputs {sorted(unknown)} of tactile sensor {config.uid!r} are unknown; use {OUTPUTS}")
        self.scene = scene
        self.pad = articulation.links_map[config.link]
        self.model = TouchModel(config, scene.num_envs, torch.device(scene.device), tuple(outputs))
        self._gauge = WrenchGauge(articulation, self.pad, config.pad_pose)
        self._depth = self._make_depth()
        self._obs: dict[str, torch.Tensor] = {}
        self._side_is_known = False
        self.reset(torch.arange(scene.num_envs, device=scene.device))

    def _make_depth(self) -> RaycastDepth | CameraDepth:
        config = self.config
        if config.backend == "sapien":
            return CameraDepth(config, self.scene, self.pad)
        gel = config.gel
        return RaycastDepth(self.scene, self.pad, config.pad_pose, gel.size, self._unfelt_links(), gel.max_sag)

    def _unfelt_links(self) -> set[str]:
        """Names of the links that the gel cannot touch: its own finger and all links between it and the robot's base."""
        names, link = set(), self.pad
        while link is not None:
            names.add(link.name)
            link = link.joint.parent_link if link.joint is not None else None
        return names

    @property
    def needs_render(self) -> bool:
        """Whether `scene.update_render` must be called before `capture`."""
        return isinstance(self._depth, CameraDepth)

    @property
    def drawn_imperfections(self) -> dict[str, torch.Tensor]:
        """What the present episodes drew of the sensor's imperfections, (N, ...) each; empty for a perfect sensor."""
        return self.model.drawn_imperfections

    def reset(self, env_idx: torch.Tensor, seeds: np.ndarray | None = None, episodes: np.ndarray | None = None) -> None:
        """Begin an episode in these environments, without shear.

        Args:
            env_idx: Indices (n,) of the environments.
            seeds: Seeds (n,) of noise and randomization; 0 if not given.
            episodes: Numbers (n,) of earlier episodes with these seeds; 0 if not given.
        """
        zeros = np.zeros(len(env_idx), np.int64)
        seeds, episodes = (zeros if given is None else np.asarray(given) for given in (seeds, episodes))
        self.model.reset(env_idx, pad_seeds(seeds, episodes, self.config.uid))

    def wrench(self) -> torch.Tensor:
        """Force and moment (N, 6), N and N m, of the world on the pad, about the pad frame's origin, in the pad frame."""
        return self._gauge.read()

    def capture(self, env_idx: torch.Tensor | None = None) -> None:
        """Sense the scene in its present state.

        Args:
            env_idx: Indices (n,) of the environments whose pads are read; all if not given. The other pads keep their last
                observation, and everything that they remember.
        """
        self._depth.look()
        wrench = self.wrench()
        self._warn_of_wrong_side(wrench)
        self._obs = self.model.observe(self._depth, wrench, env_idx)

    def _warn_of_wrong_side(self, wrench: torch.Tensor) -> None:
        """Warn once if the gel is pulled, which nothing that it touches can do; only on the CPU, where the check is cheap.

        A gel that was pressed before faces the right way: what pulls it then has caught its edge from behind.
        """
        if self._side_is_known or wrench.device.type != "cpu":
            return
        pull, push = wrench[:, 2].max().item(), -wrench[:, 2].min().item()
        self._side_is_known = max(pull, push) >= CLEAR_FORCE
        if pull < CLEAR_FORCE:
            return
        log.warning(
            "the tactile sensor %r is pulled by %.1f N and feels nothing: its pad_pose faces away from what it touches; its "
            "z axis must point out of the gel (see manifeel_ms3.sensors.pad_pose)",
            self.config.uid,
            pull,
        )

    def get_obs(self, **kwargs) -> dict[str, torch.Tensor]:
        """Observation of the last `capture`.

        `rgb`: uint8 (N, 240, 320, 3). `force_field`: float32 (N, 10, 14, 3), N per taxel, pad frame, force of the object on the
        gel: normal (>= 0, into the gel), shear along increasing rows, shear along increasing columns. `penetration`: float32
        (N, 10, 14), m. With units "tacsl", the force field is that of `taxels.tacsl_field`. Drift and noise
        (`ImperfectionConfig`) may make a normal reading negative. Sizes are those of the sensor's configuration.
        """
        return {name: values.clone() for name, values in self._obs.items()}  # which callers may change

    def get_params(self) -> dict[str, torch.Tensor]:
        """Pose of the pad in the world, (N, 7), m and wxyz."""
        return dict(pose=(self.pad.pose * self.config.pad_pose).raw_pose)

    def get_images(self, obs: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Images of an observation for people, uint8 (N, H, W, 3)."""
        images = {}
        if "rgb" in obs:
            images["rgb"] = obs["rgb"]
        if "force_field" in obs:
            images["force_field"] = force_field_images(obs["force_field"], self.config.full_scale, self.config.image_shape)
        return images
