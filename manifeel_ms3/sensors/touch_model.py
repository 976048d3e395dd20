"""From depth and wrench to the observations of a gel-based sensor, for N pads at once, with or without a scene."""

from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own usage)

from .config import GelConfig, TactileSensorConfig
from .depth.raycast import Window
from .imperfections import Imperfections
from .mechanics.contact import MAX_TILT, ContactGrid, depth_below_face, solve_indentation, solve_shear
from .mechanics.taxels import MIN_SUM, Taxels, tacsl_field
from .optics.tacrgb import Optics
from .warp_device import use_torch_threads_for_warp

CONTACT_CELL = 3.5e-4  # m: puts the contact's outline within a tenth of a millimetre; 6,279 cells on the R1.5
LOOK_MARGIN = 5.0e-4  # m: pixels are computed where an object is nearer than this at a cell or at one beside it (chosen)
OUTPUTS = ("rgb", "force_field")


class Depth(Protocol):
    """Height of the surfaces near N pads at their present poses."""

    def heights(self, grid: torch.Tensor, window: Window | None = None) -> torch.Tensor:
        """Height (N, C), m, above (+: into) the face at points (C, 2); outside the window the value may be -REACH."""
        ...


class MovingDepth(Depth, Protocol):
    """Depth with velocities, which units="tacsl" needs."""

    def sliding(self, grid: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Heights, and velocity (N, C, 2), m/s, of the pad along the surface that it faces."""
        ...


@dataclass
class GelProperties:
    """Properties of N gels that may differ from episode to episode; (N,) float64 each."""

    normal_stiffness: torch.Tensor
    """Pressure per penetration, N/m^3."""
    shear_stiffness: torch.Tensor
    """Traction per shear displacement, N/m^3."""
    friction: torch.Tensor
    """Coulomb coefficient."""

    @classmethod
    def nominal(cls, gel: GelConfig, num_pads: int, device: torch.device) -> "GelProperties":
        """The config's values for every pad."""
        values = (gel.normal_stiffness, gel.shear_stiffness, gel.friction)
        return cls(*(torch.full((num_pads,), value, dtype=torch.float64, device=device) for value in values))


class TouchModel:
    """Gel, taxels and optics of N equal pads, with the memory of their shear.

    Args:
        config: Configuration of the pads.
        num_pads: Number N of pads.
        device: Device on which everything is computed.
        outputs: Outputs of `observe`, of "rgb" and "force_field"; the rest is not computed.
    """

    def __init__(self, config: TactileSensorConfig, num_pads: int, device: torch.device, outputs: tuple[str, ...] = OUTPUTS):
        self.config, self.outputs = config, outputs
        self.grid = ContactGrid.covering(config.gel.size, CONTACT_CELL, device)
        self.cells = torch.stack([self.grid.x, self.grid.y], dim=-1).float()
        self.pixels = pixel_grid(config, device)
        self.taxels = Taxels(self.grid, config.taxel_shape, config.taxel_pitch)
        self.optics = Optics(config, self.grid, num_pads, device) if "rgb" in outputs else None
        self._computes_forces = "force_field" in outputs and config.units == "newton"
        self._bristle = torch.zeros(num_pads, len(self.cells), 2, dtype=torch.float64, device=device)
        places = (self.cells, self.pixels, self.taxels.centres.flatten(0, 1))
        self._cell_sag, self._pixel_sag, self._taxel_sag = (_sag(config.gel, points) for points in places)
        self._gel = GelProperties.nominal(config.gel, num_pads, device)
        self._obs: dict[str, torch.Tensor] = {}  # the last observation
        self._imperfections = None if config.imperfections.is_none else Imperfections(config, num_pads, device)

    @property
    def drawn_imperfections(self) -> dict[str, torch.Tensor]:
        """What the present episodes drew of the imperfections (`ImperfectionConfig.draw`); empty for a perfect sensor."""
        return {} if self._imperfections is None else self._imperfections.drawn

    def reset(self, pads: torch.Tensor, seeds: np.ndarray) -> None:
        """Begin an episode on these pads: no shear, and gel and light drawn anew from the seeds (one for each pad)."""
        self._bristle[pads] = 0.0
        gel, device = self.config.gel, self._bristle.device
        stiffness, friction = (torch.from_numpy(f).to(device) for f in self.config.randomization.draw_gels(seeds))
        self._gel.normal_stiffness[pads] = gel.normal_stiffness * stiffness
        self._gel.shear_stiffness[pads] = gel.shear_stiffness * stiffness
        self._gel.friction[pads] = gel.friction * friction
        if self.optics is not None:
            self.optics.reset(pads, seeds)
        if self._imperfections is not None:
            self._imperfections.reset(pads, seeds)

    @property
    def _memory(self) -> dict[str, torch.Tensor]:
        """The last observation, and what the next one depends on besides the present state, (N, ...) each; not copies."""
        optics = {} if self.optics is None else self.optics.memory
        imperfections = {} if self._imperfections is None else self._imperfections.memory
        return dict(bristle=self._bristle) | self._obs | optics | imperfections

    def observe(self, depth: Depth, wrench: torch.Tensor, pads: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Advance by one control step and return the observation, as described in `TactileSensor.get_obs`.

        Args:
            depth: Surfaces near the pads; a `MovingDepth` for units="tacsl".
            wrench: (N, 6) float64, N and N m, force and moment of the world on the pads, about the pad frames' origins.
            pads: Indices (n,) of the pads that advance; all if not given. The others keep their memory, and their rows of the
                observation are those of their last one.
        """
        with use_torch_threads_for_warp():
            if pads is None:
                self._obs = self._observe(depth, wrench)
            else:
                self._observe_some(pads, depth, wrench)
        return self._obs

    def _observe_some(self, pads: torch.Tensor, depth: Depth, wrench: torch.Tensor) -> None:
        others = torch.ones(len(self._bristle), dtype=torch.bool, device=self._bristle.device)
        others[pads] = False
        kept = {name: values[others] for name, values in self._memory.items()}  # copies
        self._obs = self._observe(depth, wrench)
        memory = self._memory
        for name, values in kept.items():
            memory[name][others] = values

    def heights(self, depth: Depth) -> torch.Tensor:
        """Height (N, C), m, of what is near, over the untouched face at the cells."""
        return _over_face(depth.heights(self.cells), self._cell_sag)

    def contact_plane(self, height: torch.Tensor, wrench: torch.Tensor) -> torch.Tensor:
        """Depth and tilts (N, 3) at which the gel carries the wrench, for heights from `heights` (`solve_indentation`)."""
        gel = self.config.gel
        # an object may lie on a dome's side
        slope = max(c * extent / 2 for c, extent in zip(gel.curvature, gel.size, strict=True))
        return solve_indentation(height, wrench, self.grid, self._gel.normal_stiffness, MAX_TILT + slope)

    def _observe(self, depth: Depth, wrench: torch.Tensor) -> dict[str, torch.Tensor]:
        height = self.heights(depth)
        plane = self.contact_plane(height, wrench)
        below = depth_below_face(height.double(), plane, self.grid.x, self.grid.y)
        obs: dict[str, torch.Tensor] = {}
        bristle = None
        if self._computes_forces or (self.optics is not None and self.config.optics.markers):
            cell_force = below.clamp(min=0.0) * (self._gel.normal_stiffness[:, None] * self.grid.area)  # (N, C), N
            shear = self._slide(cell_force, wrench)
            bristle = self._bristle
            if self._computes_forces:
                obs["force_field"] = self.taxels.forces(cell_force, shear, self._gel.friction).float()
                obs["penetration"] = self._mean_depth(below.clamp(0.0, self.config.gel.max_penetration), cell_force)
        if "force_field" in self.outputs and self.config.units == "tacsl":
            obs |= self._tacsl_observation(cast(MovingDepth, depth), plane)
        if self._imperfections is not None and "force_field" in obs:
            obs["force_field"] = self._imperfections.sense_forces(obs["force_field"])
            obs["penetration"] = self._imperfections.sense_penetration(obs["penetration"])
        if self.optics is not None:
            obs["rgb"] = self._image(self.optics, self._pixel_penetration(depth, plane, below), bristle)
        if self._imperfections is not None:
            obs = self._imperfections.delayed(obs)
            self._imperfections.end_step()
        return obs

    def _image(self, optics: Optics, penetration: torch.Tensor, bristle: torch.Tensor | None) -> torch.Tensor:
        """TacRGB (N, H, W, 3) of the penetration (N, H, W), m."""
        if self._imperfections is not None:
            penetration = self._imperfections.recovered_surface(penetration)
            self._imperfections.disturb(optics)
        return optics.shade(optics.surface(penetration), bristle)

    def _slide(self, cell_force: torch.Tensor, wrench: torch.Tensor) -> torch.Tensor:
        """Shear force (N, C, 2), N, of the cells; their deflections are kept for the next step."""
        stiffness = self._gel.shear_stiffness
        shear = solve_shear(self._bristle, cell_force, wrench, self.grid, stiffness, self._gel.friction)
        self._bristle = shear / (stiffness[:, None, None] * self.grid.area)
        return shear

    def _mean_depth(self, below: torch.Tensor, cell_force: torch.Tensor) -> torch.Tensor:
        """Penetration (N, rows, cols), m, of each taxel: mean over its cells, weighted by their force."""
        sums = self.taxels.add_up(torch.stack([below * cell_force, cell_force], dim=-1))
        return (sums[..., 0] / sums[..., 1].clamp(min=MIN_SUM)).float()

    def _tacsl_observation(self, depth: MovingDepth, plane: torch.Tensor) -> dict[str, torch.Tensor]:
        centres = self.taxels.centres.flatten(0, 1).float()
        height, velocity = depth.sliding(centres)
        height = _over_face(height, self._taxel_sag)
        below = depth_below_face(height, plane, centres[:, 0], centres[:, 1]).clamp(0.0, self.config.gel.max_penetration)
        shape = self.config.taxel_shape
        return dict(force_field=tacsl_field(below, velocity).unflatten(1, shape), penetration=below.unflatten(1, shape))

    def _pixel_penetration(self, depth: Depth, plane: torch.Tensor, below: torch.Tensor) -> torch.Tensor:
        """Penetration (N, H, W), m, at the pixels; depth is measured only where the cells show something near."""
        nearest = F.max_pool2d(below.float().unflatten(1, self.grid.shape)[:, None], 3, stride=1, padding=1)[:, 0]
        window = Window(nearest > -LOOK_MARGIN, self.config.gel.size)
        height = _over_face(depth.heights(self.pixels, window), self._pixel_sag)
        below = depth_below_face(height, plane, self.pixels[:, 0], self.pixels[:, 1])
        return below.clamp(0.0, self.config.gel.max_penetration).unflatten(1, self.config.image_shape)


def _sag(gel: GelConfig, points: torch.Tensor) -> torch.Tensor | None:
    """Depth (C,), m, of the untouched face under its highest point at points (C, 2) of it; None for a flat face."""
    if gel.is_flat:
        return None
    return torch.as_tensor(gel.sag(*points.double().cpu().numpy().T), dtype=torch.float32, device=points.device)


def _over_face(height: torch.Tensor, sag: torch.Tensor | None) -> torch.Tensor:
    """Height (N, C), m, over the untouched face, of a height over the plane through the face's highest point."""
    return height if sag is None else height - sag


def pixel_grid(config: TactileSensorConfig, device: torch.device) -> torch.Tensor:
    """Pixel centres (H W, 2) of the image in the pad frame, m."""
    rows, cols = config.image_shape
    x = (torch.arange(rows, device=device) - (rows - 1) / 2) * config.pixel_size
    y = (torch.arange(cols, device=device) - (cols - 1) / 2) * config.pixel_size
    return torch.stack(torch.meshgrid(x, y, indexing="ij"), dim=-1).reshape(-1, 2).float()
