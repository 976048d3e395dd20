"""Train an Equivariant Diffusion Policy on demonstrations.

    python baselines/equivariant_diffusion_policy/train.py paper --demos trajectory.h5 --obs-mode rgb+tacff
    python baselines/equivariant_diffusion_policy/train.py cpu --demos trajectory.h5 --obs-mode rgb+tacff

`paper` has the paper's hyperparameters, `cpu` a small network for two cores.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from baselines.common.encoders import EncoderConfig
from baselines.common.presets import for_cpu
from baselines.common.training import TrainArgs
from baselines.equivariant_diffusion_policy.policy import EquivariantConfig, EquivariantDiffusionPolicy
from baselines.registry import PolicySpec, Preset, preset_cli
from manifeel_ms3.command_line import run


@dataclass
class Args(TrainArgs):
    policy: EquivariantConfig = field(default_factory=lambda: EquivariantConfig(encoder=EncoderConfig(crop=230)))
    inference_steps: int = 100
    """denoising steps of DDIM, in evaluation"""
    run_dir: Path = Path("runs/equivariant_diffusion_policy")


PRESETS = {
    "paper": Preset("the paper's hyperparameters", Args(demos=())),
    "cpu": Preset("a small network for two CPU cores", for_cpu(Args(demos=()), inference_steps=8, hidden=16)),
}

SPEC = PolicySpec(EquivariantDiffusionPolicy, Args, PRESETS)


def main(args: Args) -> Path:
    """Train, and return the last checkpoint."""
    return SPEC.train(args)


if __name__ == "__main__":
    sys.exit(run(main, preset_cli(SPEC)))
