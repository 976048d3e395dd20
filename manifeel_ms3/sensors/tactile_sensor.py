"""A gel-based tactile sensor (GelSight and its kin) for ManiSkill environments."""

import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.sensors.base_sensor import BaseSensor
from mani_skill.utils.structs import Articulation

from .config import TactileSensorConfig
from .contact import ContactGrid, penetration, solve_indentation, solve_shear, taxel_weights
from .depth_camera import CameraDepth
from .optics import Optics
from .raycast import RaycastDepth
from .visualisation import force_field_images
from .wrench import WrenchGauge

CONTACT_CELL = 3.5e-4  # m: a tenth of a millimetre of error in the contact's outline; 6,188 cells on the R1.5
OUTPUTS = ("rgb", "force_field")


class TactileSensor(BaseSensor):
    """One pad of a robot: wrench, shape of what presses, and from both a force field and an image.

    - Wrench: the force and moment that the engine carries through the pad's fixed joint.
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
        RuntimeError: backend "sapien" without a renderer.
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
        self.scene, self.articulation, self.outputs = scene, articulation, outputs
        self.pad = articulation.links_map[config.link]
        self._gauge = WrenchGauge(articulation, self.pad)
        self.grid = ContactGrid.covering(config.gel.size, CONTACT_CELL, scene.device)
        self._cells = torch.stack([self.grid.x, self.grid.y], dim=-1).float()
        self._taxel_weights = taxel_weights(self.grid, config.taxel_shape, config.taxel_pitch)
        self._pixels = _pixel_grid(config, scene.device)
        self._optics = Optics(config, scene.device) if "rgb" in outputs else None
        self._depth = self._make_depth()
        self._bristle = torch.zeros(scene.num_envs, len(self._cells), 2, dtype=torch.float64, device=scene.device)
        self._obs: dict[str, torch.Tensor] = {}

    def _make_depth(self):
        if self.config.backend == "sapien":
            return CameraDepth(self.config.uid, self.scene, self.pad, self.config.gel.size, self.config.pixel_size)
        return RaycastDepth(
            self.scene, self.pad, self.config.gel.size, self._unfelt_links()
        )  # "auto": the faster one on CPU and GPU

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

    def reset(self, env_idx: torch.Tensor) -> None:
        """Forget the shear history of these environments."""
        self._bristle[env_idx] = 0.0

    def reseed(self, seed: int) -> None:
        """Start the image noise of an episode anew."""
        if self._optics is not None:
            self._optics.reseed(seed)

    def wrench(self) -> torch.Tensor:
        """Force and moment (N, 6), N and N m, of the world on the pad, about the pad frame's origin, in the pad frame."""
        return self._gauge.read()

    def capture(self) -> None:
        gel = self.config.gel
        wrench = self.wrench()
        grids = [self._cells, self._pixels] if self._optics is not None else [self._cells]
        heights = self._depth.heights(grids)
        cell_height = heights[0].to(torch.float64)
        plane = solve_indentation(cell_height, wrench, self.grid, gel.normal_stiffness)
        self._obs = {}
        if "force_field" in self.outputs:
            self._obs |= self._feel(cell_height, plane, wrench)
        if self._optics is not None:
            depth = penetration(heights[1], plane, self._pixels[:, 0], self._pixels[:, 1], gel.max_penetration)
            surface = self._optics.surface(depth.reshape(-1, *self.config.image_shape).float())
            self._obs["rgb"] = self._optics.shade(surface)

    def _feel(self, height: torch.Tensor, plane: torch.Tensor, wrench: torch.Tensor) -> dict[str, torch.Tensor]:
        gel, grid = self.config.gel, self.grid
        depth = penetration(height, plane, grid.x, grid.y, gel.max_penetration)
        pressure = depth * (gel.normal_stiffness * grid.area)  # (N, C), N
        shear = solve_shear(self._bristle, pressure, wrench, grid, gel.shear_stiffness, gel.friction)
        self._bristle = shear / (gel.shear_stiffness * grid.area)
        values = torch.stack([pressure, shear[..., 0], shear[..., 1], depth * pressure], dim=-1)
        taxels = (self._taxel_weights @ values).unflatten(1, self.config.taxel_shape)
        force = taxels[..., :3]
        mean_depth = taxels[..., 3] / taxels[..., 0].clamp(min=1e-9)  # of the pressed part of a taxel
        return dict(force_field=force.float(), penetration=mean_depth.float())

    def get_obs(self, **kwargs) -> dict[str, torch.Tensor]:
        """What the last `capture` saw.

        `rgb` uint8 (N, 240, 320, 3). `force_field` float32 (N, 10, 14, 3), N per taxel, pad frame, of the object on the gel:
        normal (>= 0, into the gel), shear along increasing rows, shear along increasing columns. `penetration` float32
        (N, 10, 14), m.
        """
        return dict(self._obs)

    def get_params(self) -> dict[str, torch.Tensor]:
        """Pad pose in the world, (N, 7), m and wxyz."""
        return dict(pose=self.pad.pose.raw_pose)

    def get_images(self, obs: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Pictures for people, uint8 (N, H, W, 3), of an observation."""
        images = {}
        if "rgb" in obs:
            images["rgb"] = obs["rgb"]
        if "force_field" in obs:
            images["force_field"] = force_field_images(obs["force_field"], self.config.image_shape)
        return images


def _pixel_grid(config: TactileSensorConfig, device: torch.device) -> torch.Tensor:
    """Pixel centres (H W, 2) of the image in the pad frame, m."""
    rows, cols = config.image_shape
    x = (torch.arange(rows, device=device) - (rows - 1) / 2) * config.pixel_size
    y = (torch.arange(cols, device=device) - (cols - 1) / 2) * config.pixel_size
    return torch.stack(torch.meshgrid(x, y, indexing="ij"), dim=-1).reshape(-1, 2).float()
