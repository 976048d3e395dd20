"""Train an Equivariant Diffusion Policy on demonstrations.

    python baselines/equivariant_diffusion_policy/train.py paper --demo-path peg.h5 --obs-mode rgb+tacff
    python baselines/equivariant_diffusion_policy/train.py cpu --demo-path peg.h5 --obs-mode rgb+tacff

The preset `paper` has the settings of the paper's public code, `cpu` has a small network that learns on a CPU core in minutes.
"""

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

from baselines.common.observation import PoseForm
from baselines.common.presets import FINE, for_cpu, in_epochs
from baselines.common.train_args import TrainArgs
from baselines.equivariant_diffusion_policy.policy import EquivariantConfig, EquivariantDiffusionPolicy
from baselines.registry import PolicySpec, Preset, next_step, preset_cli
from manifeel_ms3.command_line import run


@dataclass
class Args(TrainArgs):
    """Settings of a training run; the defaults are those of the paper's public code."""

    policy: EquivariantConfig = field(default_factory=EquivariantConfig)
    pose: PoseForm = "rotation_6d"
    """Form of the tool's pose; "rotation_6d" as in the public code, because quaternions do not turn as vectors do."""
    inference_steps: int = 100
    """Number of denoising steps of DDIM in evaluation."""


SMALL = replace(FINE, image="small_cnn", crop=78)
"""Encoders of the preset `cpu`; the equivariant network over camera images is too slow for larger images."""
CPU = for_cpu(Args(demos=()), inference_steps=8, encoder=SMALL, image_size=80, steps=3500, hidden=64)
"""Settings of the preset `cpu`, from which those of `cpu_long` follow."""
PRESETS = {
    "paper": Preset("The settings of the paper's public code.", Args(demos=())),
    "cpu": Preset("A small network that learns on a CPU core in minutes.", CPU),
    "cpu_long": Preset(
        "The preset `cpu`, for longer on long tasks, and with less noise on the pose.", in_epochs(CPU, epochs=15)
    ),
}

SPEC = PolicySpec(EquivariantDiffusionPolicy, Args, PRESETS)


def main(args: Args) -> Path:
    """Train, and return the last checkpoint."""
    return SPEC.train(args)


if __name__ == "__main__":
    sys.exit(run(main, preset_cli(SPEC), next_step))
