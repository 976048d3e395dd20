"""Two policies that ignore what they observe; a trained policy must do better than both.

Evaluate them with `manifeel eval`:

    --policy baselines.references:MeanAction --policy-kwargs '{"demos": "trajectory.h5"}'
    --policy baselines.references:Untrained --policy-kwargs '{"checkpoint": "runs/peg/checkpoints/last"}'

and with `--env-id` and `--obs-mode`, because neither has a checkpoint that says them.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from manifeel_ms3.demonstrations import read_demonstrations
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config

from .common.agent import PolicyAgent, build_policy
from .registry import policy_spec


class MeanAction:
    """Behaviour cloning without observations: the action is always the mean over all steps of the demonstrations.

    Args:
        demos: Trajectory file.
    """

    def __init__(self, demos: str):
        self.action = np.concatenate([episode["actions"] for episode in read_demonstrations(Path(demos), [])]).mean(0)

    def reset(self) -> None:
        """Do nothing: there is no state."""

    def act(self, _obs: dict[str, Any]) -> np.ndarray:
        """The mean action (A,)."""
        return self.action


class Untrained(PolicyAgent):
    """A checkpoint's network with its weights before training, and with the normalisation of its demonstrations.

    Args:
        checkpoint: Folder of the checkpoint.
    """

    def __init__(self, checkpoint: str):
        policy_class = policy_spec(checkpoint_config(Path(checkpoint))["policy_name"]).policy_class
        super().__init__(Path(checkpoint), policy_class)
        torch.manual_seed(self.config["seed"])
        drawn = dict(build_policy(self.config, policy_class).named_parameters())
        with torch.no_grad():
            for name, weights in self.policy.named_parameters():
                weights.copy_(drawn[name])
