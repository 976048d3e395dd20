"""Train a Diffusion Policy on demonstrations.

    python baselines/diffusion_policy/train.py paper --demos trajectory.h5 --obs-mode rgb+tacff
    python baselines/diffusion_policy/train.py cpu --demos trajectory.h5 --obs-mode rgb+tacff

The preset `paper` has the paper's hyperparameters, `cpu` a small network that learns on two CPU cores in minutes.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from baselines.common.presets import for_cpu
from baselines.common.train_args import TrainArgs
from baselines.diffusion_policy.policy import DiffusionConfig, DiffusionPolicy
from baselines.registry import PolicySpec, Preset, preset_cli
from manifeel_ms3.command_line import run


@dataclass
class Args(TrainArgs):
    """Settings of a training run; the defaults are the paper's."""

    policy: DiffusionConfig = field(default_factory=DiffusionConfig)
    inference_steps: int = 100
    """Number of denoising steps in evaluation; with as many as diffusion steps the sampler is DDPM, with fewer DDIM."""
    lr: float = 8e-5


PRESETS = {
    "paper": Preset("The paper's hyperparameters.", Args(demos=())),
    "cpu": Preset(
        "A small network that learns on two CPU cores in minutes.",
        for_cpu(Args(demos=()), inference_steps=8, prediction="sample"),
    ),
}

SPEC = PolicySpec(DiffusionPolicy, Args, PRESETS)


def main(args: Args) -> Path:
    """Train, and return the last checkpoint."""
    return SPEC.train(args)


if __name__ == "__main__":
    sys.exit(run(main, preset_cli(SPEC)))
