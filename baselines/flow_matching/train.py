"""Train a Flow Matching policy on demonstrations.

    python baselines/flow_matching/train.py paper --demo-path peg.h5 --obs-mode rgb+tacff
    python baselines/flow_matching/train.py consistency --demo-path peg.h5 --obs-mode rgb+tacff
    python baselines/flow_matching/train.py cpu --demo-path peg.h5 --obs-mode rgb+tacff

The preset `paper` has the settings of the paper's public code, `consistency` trains for generation in one step, and `cpu` has a
small network that learns on a CPU core in minutes.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from baselines.common.presets import for_cpu
from baselines.common.train_args import TrainArgs
from baselines.flow_matching.policy import FlowConfig, FlowMatchingPolicy
from baselines.registry import PolicySpec, Preset, next_step, preset_cli, small_presets
from manifeel_ms3.command_line import run


@dataclass
class Args(TrainArgs):
    """Settings of a training run; the defaults are those of the paper's public code, except for its start noise."""

    policy: FlowConfig = field(default_factory=FlowConfig)
    inference_steps: int = 100
    """Number of Euler steps from noise to actions in evaluation; 100 as in the paper's table and its public code."""


CPU = for_cpu(Args(demos=()), inference_steps=8, prediction="sample")
"""Settings of the preset `cpu`, from which those of the other small presets follow."""
PRESETS = {
    "paper": Preset("The settings of the paper's public code.", Args(demos=())),
    "consistency": Preset(
        "Consistency training, for generation in one step.",
        Args(demos=(), policy=FlowConfig(consistency=True), inference_steps=1),
    ),
    **small_presets(CPU),
}

SPEC = PolicySpec(FlowMatchingPolicy, Args, PRESETS)


def main(args: Args) -> Path:
    """Train, and return the last checkpoint."""
    return SPEC.train(args)


if __name__ == "__main__":
    sys.exit(run(main, preset_cli(SPEC), next_step))
