# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# pyright: reportCallIssue=false, reportArgumentType=false, reportIndexIssue=false, reportOperatorIssue=false
# (warp reads a kernel's annotations as its own types, and its stubs do not know the vectors' operators)
"""Imperfections of N pads: what `ImperfectionConfig` asks for, applied to the true signal.

The force field passes, in this order, through hysteresis, crosstalk, gain, drift, noise and dead taxels; the image through
hysteresis of the gel's surface, drift of the colours and noise. All outputs then pass through the delay. The penetration is
zero at dead taxels, and true at the others.
"""

import numpy as np
import torch
import warp as wp

from .config import TactileSensorConfig
from .imperfection_config import DRIFT_STEPS, FULL_SCALE_LEVEL
from .optics.tacrgb import Optics
from .warp_device import warp_device

MIN_LOAD = 1e-12  # N or m: avoids a division by zero
NOISE_KEY = 0x5BD1E995  # makes the force field's noise differ from the image's, which has the same seed; arbitrary

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _add_noise(
    field: wp.array2d(dtype=wp.float32),  # (N, M)
    deviation: wp.array(dtype=wp.float32),  # (N,)
    seed: wp.array(dtype=wp.int32),  # (N,)
    frame: wp.array(dtype=wp.int32),  # (N,)
):
    n, m = wp.tid()
    state = wp.rand_init(seed[n], frame[n] * field.shape[1] + m)
    field[n, m] += deviation[n] * wp.randn(state)


class Imperfections:
    """Imperfections of N equal pads, with their memory.

    Args:
        config: Configuration of the pads.
        num_pads: Number N of pads.
        device: Device on which everything is computed.
    """

    def __init__(self, config: TactileSensorConfig, num_pads: int, device: torch.device):
        self.config, self.device = config, device
        self._full_scale = config.full_scale
        self._drawn = {
            name: torch.as_tensor(values, device=device)
            for name, values in config.imperfections.draw(np.zeros(num_pads, int), config.taxel_shape).items()
        }
        self._seed, self._frame = torch.zeros(2, num_pads, dtype=torch.int32, device=device)
        self._held = torch.zeros(num_pads, *config.taxel_shape, device=device)  # normal reading of the play operator
        self._surface = torch.zeros(num_pads, *config.image_shape, device=device)  # m into the gel
        self._past: dict[str, torch.Tensor] = {}  # by output: (N, steps + 1, ...), steps in turn

    @property
    def drawn(self) -> dict[str, torch.Tensor]:
        """What the present episodes drew, as `ImperfectionConfig.draw` returns it."""
        return {name: values.clone() for name, values in self._drawn.items()}

    @property
    def memory(self) -> dict[str, torch.Tensor]:
        """What the next observation depends on besides the present state, (N, ...) each; not copies."""
        own = dict(frame=self._frame, held=self._held, surface=self._surface)
        return own | {f"past_{name}": values for name, values in self._past.items()}

    def reset(self, pads: torch.Tensor, seeds: np.ndarray) -> None:
        """Begin an episode on these pads, with draws from the seeds (one for each pad) and no memory."""
        for name, values in self.config.imperfections.draw(seeds, self.config.taxel_shape).items():
            self._drawn[name][pads] = torch.as_tensor(values, device=self.device)
        self._seed[pads] = torch.as_tensor(seeds.astype(np.int64) ^ NOISE_KEY, device=self.device).to(torch.int32)
        self._frame[pads] = 0
        self._held[pads] = 0.0
        self._surface[pads] = 0.0

    def recovered_surface(self, penetration: torch.Tensor) -> torch.Tensor:
        """Penetration (N, H, W), m, of a gel that recovers late; `penetration` is that of the object that presses now."""
        self._surface = self._play(self._surface, penetration)
        return self._surface

    def _play(self, held: torch.Tensor, load: torch.Tensor) -> torch.Tensor:
        """The play operator: `held`, clipped to the range from the load to 1 / (1 - hysteresis) times the load."""
        factor = 1.0 / (1.0 - self._amount("hysteresis", load.ndim))
        return torch.maximum(load, torch.minimum(held, factor * load))

    def _amount(self, name: str, ndim: int) -> torch.Tensor:
        return self._drawn[name].float().view(-1, *[1] * (ndim - 1))

    def sense_forces(self, field: torch.Tensor) -> torch.Tensor:
        """Readings (N, rows, cols, 3) of the taxels, whose true force field is `field`."""
        self._held = self._play(self._held, field[..., 0])
        field = field * (self._held / field[..., 0].clamp(min=MIN_LOAD))[..., None]
        field = self._mixed(field) * self._drawn["gain"].float()[..., None]
        field = field + self._full_scale / DRIFT_STEPS * self._frame.view(-1, 1, 1, 1) * self._drawn["drift_force"].float()
        noisy = field.flatten(1).contiguous()
        deviation = self._full_scale * self._drawn["noise"].float()
        inputs = [wp.from_torch(array) for array in (noisy, deviation, self._seed, self._frame)]
        wp.launch(_add_noise, dim=tuple(noisy.shape), inputs=inputs, device=warp_device(self.device))
        return noisy.view_as(field).masked_fill(self._drawn["dead_taxels"][..., None], 0.0)

    def sense_penetration(self, penetration: torch.Tensor) -> torch.Tensor:
        """Penetration (N, rows, cols), m, that the taxels report; it is zero at dead taxels."""
        return penetration.masked_fill(self._drawn["dead_taxels"], 0.0)

    def _mixed(self, field: torch.Tensor) -> torch.Tensor:
        """The field after each taxel has given a quarter of its crosstalk to each neighbour that it has."""
        quarter = self._amount("crosstalk", 4) / 4
        down, right = quarter * (field[:, :-1] - field[:, 1:]), quarter * (field[:, :, :-1] - field[:, :, 1:])
        mixed = field.clone()
        mixed[:, :-1] -= down
        mixed[:, 1:] += down
        mixed[:, :, :-1] -= right
        mixed[:, :, 1:] += right
        return mixed

    def disturb(self, optics: Optics) -> None:
        """Set drift and noise of the next image."""
        drift = FULL_SCALE_LEVEL / DRIFT_STEPS * self._frame[:, None] * self._drawn["drift_colour"].float()
        read = FULL_SCALE_LEVEL * self._drawn["noise"].float()
        optics.drift.copy_(drift)
        optics.noise.copy_((self.config.optics.noise**2 + read**2).sqrt())

    def delayed(self, obs: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Observation of `delay` steps ago, or the episode's first one; `obs` is that of this step."""
        slots = int(self.config.imperfections.delay[1]) + 1
        if slots == 1:
            return obs
        first, now = self._frame == 0, self._frame.long()
        then = now - self._drawn["delay"]
        pads = torch.arange(len(then), device=self.device)
        for name, values in obs.items():
            if name not in self._past:
                self._past[name] = values[:, None].repeat(1, slots, *[1] * (values.ndim - 1))
            past = self._past[name]
            past.copy_(torch.where(first.view(-1, *[1] * values.ndim), values[:, None], past))
            past[pads, now % slots] = values
        return {name: self._past[name][pads, then % slots] for name in obs}

    def end_step(self) -> None:
        """Let the next observation be that of the next step, on which drift, noise and delay depend."""
        self._frame += 1
