"""Train a Diffusion Policy on demonstrations.

    python baselines/diffusion_policy/train.py paper --demo-path peg.h5 --obs-mode rgb+tacff
    python baselines/diffusion_policy/train.py cpu --demo-path peg.h5 --obs-mode rgb+tacff

The preset `paper` has the settings of the paper's public code, `cpu` has a small network that learns on a CPU core in minutes.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from baselines.common.encoders import IMAGE_ENCODERS
from baselines.common.presets import for_cpu
from baselines.common.train_args import PUBLIC_CODE_LR, TrainArgs
from baselines.diffusion_policy.policy import DiffusionConfig, DiffusionPolicy
from baselines.registry import PolicySpec, Preset, next_step, preset_cli, small_presets
from manifeel_ms3.command_line import run

LR = 8e-5
"""Learning rate in the paper and in its public code; with UniT, T3 and AnyTouch the code has 1e-4."""


@dataclass
class Args(TrainArgs):
    """Settings of a training run; the defaults are those of the paper's public code."""

    policy: DiffusionConfig = field(default_factory=DiffusionConfig)
    inference_steps: int = 100
    """Number of denoising steps in evaluation; the sampler is DDPM if it equals the number of diffusion steps, DDIM if it is
    less."""

    def public_code_lr(self):
        from_scratch = "tacrgb" not in self.obs_mode.split("+") or self.policy.encoder.tacrgb in IMAGE_ENCODERS
        return LR if from_scratch else PUBLIC_CODE_LR


CPU = for_cpu(Args(demos=()), inference_steps=8, prediction="sample")
"""Settings of the preset `cpu`, from which those of the other small presets follow."""
PRESETS = {
    "paper": Preset("The settings of the paper's public code.", Args(demos=())),
    **small_presets(CPU),
}

SPEC = PolicySpec(DiffusionPolicy, Args, PRESETS)


def main(args: Args) -> Path:
    """Train, and return the last checkpoint."""
    return SPEC.train(args)


if __name__ == "__main__":
    sys.exit(run(main, preset_cli(SPEC), next_step))
