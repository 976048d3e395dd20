"""Flow Matching (Lipman et al. 2023; Zhang & Gienger 2024 for robots): actions flow from noise along straight paths.

With `consistency` it is trained by Consistency Flow Matching (Yang et al. 2024, eq. 6), as FlowPolicy (Zhang et al. 2025) is.
"""

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F  # noqa: N812

from baselines.common.policy import PolicyConfig, VisuotactilePolicy, draw_rows
from manifeel_ms3.arguments import require_at_least
from manifeel_ms3.errors import InvalidArgumentError

TIME_SCALE = 100.0
"""Factor from a time in [0, 1] to the range of diffusion steps for which the U-Net's embedding is made."""


@dataclass
class FlowConfig(PolicyConfig):
    """Settings of Flow Matching; by default the network learns the velocity along straight paths, from Gaussian noise."""

    prediction: Literal["velocity", "sample"] = "velocity"
    """Output of the network: the velocity, as in the paper, or the clean actions to which it leads, which a short training
    learns far sooner."""
    consistency: bool = False
    """Train velocities to agree along a path and to lead to the same end, so that few generation steps suffice."""
    segments: int = 1
    """Number of segments of a path, each with an end of its own; generation needs at least as many steps. Used only
    with consistency."""
    interval: float = 0.01
    """Time between the two points of a path that must agree; the whole path takes time 1."""
    velocity_weight: float = 1e-5
    """Weight in the loss of the difference between the two velocities. Used only with consistency."""
    public_code: bool = False
    """Reproduce two traits of the paper's public code: generation starts from noise that is uniform in [0, 1], though training
    draws Gaussian noise, and the network is given the time in [0, 1] instead of [0, 100]."""

    def __post_init__(self):
        super().__post_init__()
        require_at_least(1, segments=self.segments)
        if not 0 < self.interval <= 1:
            raise InvalidArgumentError(f"interval={self.interval} must be a time above 0 and at most 1")

    @property
    def least_inference_steps(self):
        return self.segments if self.consistency else 1


class FlowMatchingPolicy(VisuotactilePolicy):
    """Flow Matching (Lipman et al. 2023): learns the velocity v(x, t) at which noise (t = 0) flows into actions (t = 1)."""

    name = "flow_matching"
    Config = FlowConfig
    config: FlowConfig  # pyright: ignore[reportIncompatibleVariableOverride] (set once, in the constructor)

    @property
    def time_scale(self) -> float:
        """Factor from a time in [0, 1] to what the network is given."""
        return 1.0 if self.config.public_code else TIME_SCALE

    def noise(self, condition, generators):
        draw = torch.rand if self.config.public_code else torch.randn
        return draw_rows(draw, (self.config.pred_horizon, self.action_dim), generators, condition.device)

    def velocity(self, x: torch.Tensor, time: torch.Tensor, condition: torch.Tensor, step: float) -> torch.Tensor:
        """The velocity (B, T, A) at points x (B, T, A) and times (B,) in [0, 1].

        Args:
            x: Points of the paths.
            time: Times of the points.
            condition: Conditions (B, ...).
            step: Time in which a velocity may lead to the end at the earliest; it bounds the velocity near time 1.
        """
        predicted = self.action_network(x, self.time_scale * time, condition)
        if self.config.prediction == "velocity":
            return predicted
        return (predicted - x) / _column((1 - time).clamp(min=step))

    def generation_loss(self, clean, condition):
        noise, time = torch.randn_like(clean), torch.rand(len(clean), device=clean.device)
        if self.config.consistency:
            return self._consistency_loss(noise, clean, time, condition)
        predicted = self.action_network(_between(noise, clean, time), self.time_scale * time, condition)
        return F.mse_loss(predicted, clean - noise if self.config.prediction == "velocity" else clean)

    def _consistency_loss(self, noise, clean, time, condition):
        """The disagreement of two points of a path: of the ends to which their velocities lead, and of the velocities."""
        end = (torch.floor(time * self.config.segments) + 1) / self.config.segments
        later = torch.minimum(time + self.config.interval, end)
        here, there = _between(noise, clean, time), _between(noise, clean, later)
        velocity = self.velocity(here, time, condition, self.config.interval)
        with torch.no_grad():
            later_velocity = self.velocity(there, later, condition, self.config.interval)
        reached = here + _column(end - time) * velocity
        later_reached = there + _column(end - later) * later_velocity
        # at a segment's end, the target is the path's own point
        target = torch.where(_column(later < end), later_reached, there)
        agreement = ((velocity - later_velocity) ** 2 * _column(later < end)).mean()
        return F.mse_loss(reached, target) + self.config.velocity_weight * agreement

    def generate(self, condition, steps, generators):
        actions = self.noise(condition, generators)
        for k in range(steps):  # Euler integration
            time = torch.full((len(actions),), k / steps, device=actions.device)
            # the last step leads to the end
            actions = actions + self.velocity(actions, time, condition, min(self.config.interval, 1 / steps)) / steps
        return actions.clamp(-1.0, 1.0)


def _column(values: torch.Tensor) -> torch.Tensor:
    return values[:, None, None]


def _between(noise: torch.Tensor, clean: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
    return torch.lerp(noise, clean, _column(time))
