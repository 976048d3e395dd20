"""Two policies that learnt nothing from what they see; what learns must beat them.

    python -m manifeel_ms3.evaluation.evaluate --policy baselines.references:MeanAction \\
        --policy-kwargs '{"demos": "trajectory.h5"}' --env-id ManiFeel-PegInsertion-v1 --obs-mode none
    python -m manifeel_ms3.evaluation.evaluate --policy baselines.references:Untrained \\
        --policy-kwargs '{"checkpoint": "runs/diffusion_policy/checkpoints/last"}' --env-id ManiFeel-PegInsertion-v1 \\
        --obs-mode rgb+tacff
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
    """Behaviour cloning that sees nothing: the mean action of all steps of the demonstrations, always."""

    def __init__(self, demos: str):
        self.action = np.concatenate([episode["actions"] for episode in read_demonstrations(Path(demos), [])]).mean(0)

    def reset(self) -> None:
        pass

    def act(self, _obs: dict[str, Any]) -> np.ndarray:
        return self.action


class Untrained(PolicyAgent):
    """A checkpoint's network as it was before training; scales of observations and actions are the data's."""

    def __init__(self, checkpoint: str):
        policy_class = policy_spec(checkpoint_config(Path(checkpoint))["policy_name"]).policy_class
        super().__init__(Path(checkpoint), policy_class)
        torch.manual_seed(self.config["seed"])
        drawn = dict(build_policy(self.config, policy_class).named_parameters())
        with torch.no_grad():
            for name, weights in self.policy.named_parameters():
                weights.copy_(drawn[name])
