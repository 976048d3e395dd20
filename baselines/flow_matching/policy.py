"""Flow Matching (Lipman et al. 2023; Zhang & Gienger 2024 for robots): actions flow along straight paths from noise.

With `consistency`, trained as FlowPolicy (Zhang et al. 2025) is: by Consistency Flow Matching (Yang et al. 2024, eq. 6).
"""

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F

from baselines.common.policy import PolicyConfig, VisuotactilePolicy

TIME_SCALE = 100.0  # the U-Net's embedding is made for step numbers up to about this


@dataclass
class FlowConfig(PolicyConfig):
    """Defaults: straight paths, the velocity learnt directly."""

    prediction: Literal["velocity", "sample"] = "velocity"
    """what the network tells: the velocity (the paper's), or where it leads to, which short trainings learn far sooner"""
    consistency: bool = False
    """ask that velocities agree along a path and lead to one end: one step is then as good as many"""
    segments: int = 1
    """of a path, each with its own end, and as many steps as generation then needs at least; with `consistency`"""
    interval: float = 0.01
    """of time, between the two points that must agree"""
    velocity_weight: float = 1e-5


class FlowMatchingPolicy(VisuotactilePolicy):
    """Learns the velocity v(x, t) at which noise (t = 0) flows into actions (t = 1)."""

    name = "flow_matching"
    Config = FlowConfig
    config: FlowConfig

    def velocity(self, x: torch.Tensor, time: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        """(B, T, A) at times (B,) in [0, 1]."""
        told = self.unet(x, TIME_SCALE * time, condition)
        if self.config.prediction == "velocity":
            return told
        return (told - x) / _column((1 - time).clamp(min=self.config.interval))

    def generation_loss(self, clean, condition):
        noise, time = torch.randn_like(clean), torch.rand(len(clean), device=clean.device)
        if self.config.consistency:
            return self._consistency_loss(noise, clean, time, condition)
        told = self.unet(_between(noise, clean, time), TIME_SCALE * time, condition)
        return F.mse_loss(told, clean - noise if self.config.prediction == "velocity" else clean)

    def _consistency_loss(self, noise, clean, time, condition):
        """Two points of a path: where their velocities lead to by the end of the segment, and the velocities themselves."""
        end = (torch.floor(time * self.config.segments) + 1) / self.config.segments
        later = torch.minimum(time + self.config.interval, end)
        here, there = _between(noise, clean, time), _between(noise, clean, later)
        velocity = self.velocity(here, time, condition)
        with torch.no_grad():
            later_velocity = self.velocity(there, later, condition)
        reached = here + _column(end - time) * velocity
        later_reached = there + _column(end - later) * later_velocity
        # at a segment's end the path itself is the answer
        target = torch.where(_column(later < end), later_reached, there)
        agreement = ((velocity - later_velocity) ** 2 * _column(later < end)).mean()
        return F.mse_loss(reached, target) + self.config.velocity_weight * agreement

    def generate(self, condition, steps, generator):
        actions = self.noise(condition, generator)
        for k in range(steps):  # Euler's
            time = torch.full((len(actions),), k / steps, device=actions.device)
            actions = actions + self.velocity(actions, time, condition) / steps
        return actions.clamp(-1.0, 1.0)


def _column(values: torch.Tensor) -> torch.Tensor:
    return values[:, None, None]


def _between(noise: torch.Tensor, clean: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
    return torch.lerp(noise, clean, _column(time))
