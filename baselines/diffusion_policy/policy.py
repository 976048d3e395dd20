"""Diffusion Policy (Chi et al. 2023, "Diffusion Policy: Visuomotor Policy Learning via Action Diffusion"), CNN version."""

from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.nn.functional as F  # noqa: N812

from baselines.common.observation import ObservationSpec
from baselines.common.policy import PolicyConfig, VisuotactilePolicy
from manifeel_ms3.arguments import require_at_least


@dataclass
class DiffusionConfig(PolicyConfig):
    """Settings of the Diffusion Policy.

    The defaults are those of the paper, and where it is silent or differs, of its public code.
    """

    diffusion_steps: int = 100
    """Number of diffusion steps in training."""
    prediction: Literal["epsilon", "sample"] = "epsilon"
    """Output of the network: the noise, as in the paper, or the clean actions, which a short training learns far sooner."""
    sampler: Literal["ddpm", "ddim"] = "ddpm"
    """Sampler if generation takes all diffusion steps; with fewer it is always DDIM (Song et al. 2021)."""

    def __post_init__(self):
        super().__post_init__()
        require_at_least(1, diffusion_steps=self.diffusion_steps)

    @property
    def least_inference_steps(self):
        return min(2, self.diffusion_steps)  # a single step of DDIM is the last one, which returns the noise

    @property
    def most_inference_steps(self):
        return self.diffusion_steps


class DiffusionPolicy(VisuotactilePolicy):
    """Diffusion Policy (Chi et al. 2023), the CNN version: denoises an action sequence."""

    name = "diffusion_policy"
    Config = DiffusionConfig
    config: DiffusionConfig  # pyright: ignore[reportIncompatibleVariableOverride] (set once, in the constructor)

    def __init__(self, config: DiffusionConfig, spec: ObservationSpec, action_dim: int):
        from diffusers.schedulers.scheduling_ddim import DDIMScheduler  # imported here, because it takes seconds
        from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

        super().__init__(config, spec, action_dim)
        schedule: dict[str, Any] = dict(
            num_train_timesteps=config.diffusion_steps,
            beta_schedule="squaredcos_cap_v2",
            prediction_type=config.prediction,
            clip_sample=True,
        )
        self.ddpm, self.ddim = DDPMScheduler(**schedule), DDIMScheduler(**schedule)

    def generation_loss(self, clean, condition):
        """The mean squared error of the predicted noise or clean actions."""
        noise = torch.randn_like(clean)
        step: Any = torch.randint(self.config.diffusion_steps, (len(clean),), device=clean.device)
        predicted = self.action_network(self.ddpm.add_noise(clean, noise, step), step, condition)
        return F.mse_loss(predicted, noise if self.config.prediction == "epsilon" else clean)

    def generate(self, condition, steps, generators):
        actions = self.noise(condition, generators)
        full = self.config.sampler == "ddpm" and steps == self.config.diffusion_steps
        scheduler: Any = self.ddpm if full else self.ddim
        scheduler.set_timesteps(steps, device=condition.device)
        for step in scheduler.timesteps:
            predicted = self.action_network(actions, step.expand(len(actions)), condition)
            extra = dict(generator=generators) if full else {}
            actions = scheduler.step(predicted, step, actions, **extra).prev_sample
        return actions
