"""Train a Diffusion Policy on demonstrations.

    python baselines/diffusion_policy/train.py paper --demos trajectory.h5 --obs-mode rgb+tacff
    python baselines/diffusion_policy/train.py cpu --demos trajectory.h5 --obs-mode rgb+tacff

`paper` has the paper's hyperparameters, `cpu` a small network that learns on two cores in minutes.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from baselines.common.presets import for_cpu
from baselines.common.training import TrainArgs
from baselines.diffusion_policy.policy import DiffusionConfig, DiffusionPolicy
from baselines.registry import PolicySpec, Preset, preset_cli
from manifeel_ms3.command_line import run


@dataclass
class Args(TrainArgs):
    policy: DiffusionConfig = field(default_factory=DiffusionConfig)
    inference_steps: int = 100
    """denoising steps in evaluation: as many as diffusion steps is DDPM, fewer is DDIM"""
    lr: float = 8e-5
    run_dir: Path = Path("runs/diffusion_policy")


PRESETS = {
    "paper": Preset("the paper's hyperparameters", Args(demos=())),
    "cpu": Preset("a small network for two CPU cores", for_cpu(Args(demos=()), inference_steps=8, prediction="sample")),
}

SPEC = PolicySpec(DiffusionPolicy, Args, PRESETS)


def main(args: Args) -> Path:
    """Train, and return the last checkpoint."""
    return SPEC.train(args)


if __name__ == "__main__":
    sys.exit(run(main, preset_cli(SPEC)))
