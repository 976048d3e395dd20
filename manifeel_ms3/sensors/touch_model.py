"""From depth and wrench to what a gel-based sensor says, for N pads at once, whatever scene they belong to."""

from typing import Protocol

import numpy as np
import torch
import torch.nn.functional as F

from .config import TactileSensorConfig
from .depth.raycast import Window
from .mechanics.contact import ContactGrid, depth_below_face, solve_indentation, solve_shear
from .mechanics.taxels import Taxels, tacsl_field
from .optics.tacrgb import Optics
from .warp_device import lend_torch_threads

CONTACT_CELL = 3.5e-4  # m: a tenth of a millimetre of error in the contact's outline; 6,279 cells on the R1.5
LOOK_MARGIN = 5.0e-4  # m: pixels are looked at where a cell, or one beside it, is nearer than this to the gel
OUTPUTS = ("rgb", "force_field")


class Depth(Protocol):
    """Height of what is near N pads, where they are now."""

    def heights(self, grid: torch.Tensor, window: Window | None = None) -> torch.Tensor:
        """Height (N, C), m, above (+: into) the face at points (C, 2); free to say "nothing" where the window is not open."""
        ...


class MovingDepth(Depth, Protocol):
    """What units="tacsl" needs besides."""

    def sliding(self, grid: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Heights, and velocity (N, C, 2), m/s, of the pad along what it faces."""
        ...


class TouchModel:
    """Gel, taxels and optics of N equal pads, with the memory of their shear.

    Args:
        config: of the pads.
        num_pads: N.
        outputs: what `observe` returns, of "rgb" and "force_field"; the rest is not computed.
    """

    def __init__(self, config: TactileSensorConfig, num_pads: int, device: torch.device, outputs: tuple[str, ...] = OUTPUTS):
        self.config, self.outputs = config, outputs
        gel = config.gel
        self.grid = ContactGrid.covering(gel.size, CONTACT_CELL, device)
        self.cells = torch.stack([self.grid.x, self.grid.y], dim=-1).float()
        self.pixels = pixel_grid(config, device)
        self.taxels = Taxels(self.grid, config.taxel_shape, config.taxel_pitch)
        self.optics = Optics(config, self.grid, num_pads, device) if "rgb" in outputs else None
        self._feels = "force_field" in outputs and config.units == "newton"
        self._bristle = torch.zeros(num_pads, len(self.cells), 2, dtype=torch.float64, device=device)
        self._nominal = torch.tensor(
            [gel.normal_stiffness, gel.shear_stiffness, gel.friction], dtype=torch.float64, device=device
        )
        self._gel = self._nominal.repeat(num_pads, 1)

    def reset(self, pads: torch.Tensor, seeds: np.ndarray) -> None:
        """Begin an episode on these pads: no shear, and gel and light drawn anew from the seeds (one a pad)."""
        self._bristle[pads] = 0.0
        limits = self.config.randomization
        for pad, seed in zip(pads.tolist(), seeds.tolist(), strict=True):
            stiffness, friction = 1 + np.random.default_rng([seed, 0]).uniform(-1, 1, 2) * [limits.stiffness, limits.friction]
            factors = torch.tensor([stiffness, stiffness, friction], dtype=torch.float64, device=self._gel.device)
            self._gel[pad] = self._nominal * factors
        if self.optics is not None:
            self.optics.reset(pads, seeds)

    def observe(self, depth: Depth, wrench: torch.Tensor) -> dict[str, torch.Tensor]:
        """One control step: `wrench` (N, 6), N and N m, of the world on the pads, about the pad frames' origins.

        Returns what `TactileSensor.get_obs` does.
        """
        with lend_torch_threads():
            return self._observe(depth, wrench)

    def _observe(self, depth: Depth, wrench: torch.Tensor) -> dict[str, torch.Tensor]:
        stiffness = self._gel[:, 0].contiguous()
        height = depth.heights(self.cells)
        plane = solve_indentation(height, wrench, self.grid, stiffness)
        below = depth_below_face(height.double(), plane, self.grid.x, self.grid.y)
        obs: dict[str, torch.Tensor] = {}
        bristle = None
        if self._feels or (self.optics is not None and self.config.optics.markers):
            pressure = below.clamp(min=0.0) * (stiffness[:, None] * self.grid.area)  # (N, C), N
            shear = self._slide(pressure, wrench)
            bristle = self._bristle
            if self._feels:
                obs["force_field"] = self.taxels.forces(pressure, shear, self._gel[:, 2]).float()
                obs["penetration"] = self._mean_depth(below.clamp(0.0, self.config.gel.max_penetration), pressure)
        if "force_field" in self.outputs and self.config.units == "tacsl":
            obs |= self._feel_as_tacsl(depth, plane)
        if self.optics is not None:
            surface = self.optics.surface(self._pressed_in(depth, plane, below))
            obs["rgb"] = self.optics.shade(surface, bristle)
        return obs

    def _slide(self, pressure: torch.Tensor, wrench: torch.Tensor) -> torch.Tensor:
        stiffness, friction = self._gel[:, 1].contiguous(), self._gel[:, 2].contiguous()
        shear = solve_shear(self._bristle, pressure, wrench, self.grid, stiffness, friction)
        self._bristle = shear / (stiffness[:, None, None] * self.grid.area)
        return shear

    def _mean_depth(self, below: torch.Tensor, pressure: torch.Tensor) -> torch.Tensor:
        """Penetration (N, rows, cols), m, of the pressed part of each taxel."""
        sums = self.taxels.add_up(torch.stack([below * pressure, pressure], dim=-1))
        return (sums[..., 0] / sums[..., 1].clamp(min=1e-9)).float()

    def _feel_as_tacsl(self, depth: MovingDepth, plane: torch.Tensor) -> dict[str, torch.Tensor]:
        centres = self.taxels.centres.flatten(0, 1).float()
        height, velocity = depth.sliding(centres)
        below = depth_below_face(height, plane, centres[:, 0], centres[:, 1]).clamp(0.0, self.config.gel.max_penetration)
        shape = self.config.taxel_shape
        return dict(force_field=tacsl_field(below, velocity).unflatten(1, shape), penetration=below.unflatten(1, shape))

    def _pressed_in(self, depth: Depth, plane: torch.Tensor, below: torch.Tensor) -> torch.Tensor:
        """Penetration (N, H, W), m, at the pixels; looked at only where the cells say that something may be."""
        nearest = F.max_pool2d(below.float().unflatten(1, self.grid.shape)[:, None], 3, stride=1, padding=1)[:, 0]
        window = Window(nearest > -LOOK_MARGIN, self.config.gel.size)
        height = depth.heights(self.pixels, window)
        below = depth_below_face(height, plane, self.pixels[:, 0], self.pixels[:, 1])
        return below.clamp(0.0, self.config.gel.max_penetration).unflatten(1, self.config.image_shape)


def pixel_grid(config: TactileSensorConfig, device: torch.device) -> torch.Tensor:
    """Pixel centres (H W, 2) of the image in the pad frame, m."""
    rows, cols = config.image_shape
    x = (torch.arange(rows, device=device) - (rows - 1) / 2) * config.pixel_size
    y = (torch.arange(cols, device=device) - (cols - 1) / 2) * config.pixel_size
    return torch.stack(torch.meshgrid(x, y, indexing="ij"), dim=-1).reshape(-1, 2).float()
