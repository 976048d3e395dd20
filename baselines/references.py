"""Policies that have learnt nothing; a trained policy must do better than each of them.

`python -m baselines.floors` measures all of them. One of them is evaluated with `manifeel eval`:

    --policy baselines.references:RandomActions --policy-kwargs '{"env_id": "ManiFeel-PegInsertion-v1"}'
    --policy baselines.references:MeanAction --policy-kwargs '{"demos": "peg.h5"}'
    --policy baselines.references:Untrained --policy-kwargs '{"checkpoint": "runs/peg/checkpoints/last"}'

Each also needs `--env-id` and `--obs-mode`, which evaluation otherwise reads from a checkpoint.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from manifeel_ms3.agents.panda_gelsight import ACTION_AXES
from manifeel_ms3.arguments import one_of
from manifeel_ms3.demonstrations import read_demonstrations
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config
from manifeel_ms3.evaluation.policy import EpisodePolicy
from manifeel_ms3.tasks.registry import task_spec

from .common.agent import PolicyAgent, build_policy
from .registry import policy_spec


class RandomActions(EpisodePolicy):
    """Actions that are drawn uniformly from [-1, 1], independently for each component and each step.

    Args:
        env_id: Id of the task.
        control_mode: Controller that takes the actions; the task's own if not given.

    Raises:
        InvalidArgumentError: Actions of the control mode are no steps of the tool.
    """

    def __init__(self, env_id: str, control_mode: str | None = None):
        mode = control_mode or task_spec(env_id).env_class.default_control_mode
        self._size = len(ACTION_AXES[one_of("control_mode", mode, ACTION_AXES)])
        self._rng = np.random.default_rng(0)

    def reset(self) -> None:
        """Begin an episode with the seed 0."""
        self.begin_episode(0)

    def begin_episode(self, seed: int) -> None:
        """Begin an episode, whose seed determines the actions."""
        self._rng = np.random.default_rng(seed)

    def act(self, _obs: dict[str, Any]) -> np.ndarray:
        """A random action (A,)."""
        return self._rng.uniform(-1.0, 1.0, self._size)


class MeanAction(EpisodePolicy):
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
