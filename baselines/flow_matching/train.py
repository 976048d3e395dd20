"""Train a Flow Matching policy on demonstrations.

    python baselines/flow_matching/train.py paper --demos trajectory.h5 --obs-mode rgb+tacff
    python baselines/flow_matching/train.py consistency --demos trajectory.h5 --obs-mode rgb+tacff
    python baselines/flow_matching/train.py cpu --demos trajectory.h5 --obs-mode rgb+tacff

`paper` has the paper's hyperparameters, `consistency` is trained for generation in one step, `cpu` is a small network that
learns on two cores in minutes.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

from baselines.common.presets import for_cpu
from baselines.common.training import TrainArgs
from baselines.flow_matching.policy import FlowConfig, FlowMatchingPolicy
from baselines.registry import PolicySpec, Preset, preset_cli
from manifeel_ms3.command_line import run


@dataclass
class Args(TrainArgs):
    policy: FlowConfig = field(default_factory=FlowConfig)
    inference_steps: int = 10
    """Euler steps from noise to actions, in evaluation"""
    run_dir: Path = Path("runs/flow_matching")


PRESETS = {
    "paper": Preset("the paper's hyperparameters", Args(demos=())),
    "consistency": Preset("for one-step generation", Args(demos=(), policy=FlowConfig(consistency=True), inference_steps=1)),
    "cpu": Preset("a small network for two CPU cores", for_cpu(Args(demos=()), inference_steps=8, prediction="sample")),
}

SPEC = PolicySpec(FlowMatchingPolicy, Args, PRESETS)


def main(args: Args) -> Path:
    """Train, and return the last checkpoint."""
    return SPEC.train(args)


if __name__ == "__main__":
    sys.exit(run(main, preset_cli(SPEC)))
