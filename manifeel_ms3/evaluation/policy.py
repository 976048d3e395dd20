"""What evaluation asks of a policy."""

import importlib
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from .checkpoint_config import CheckpointError, checkpoint_config


class Policy(Protocol):
    """Any object with these two methods can be evaluated."""

    def reset(self) -> None:
        """A new episode begins: forget everything, reseed all randomness."""
        ...

    def act(self, obs: dict[str, Any]) -> np.ndarray:
        """Action (A,) in [-1, 1] for the environment's observation (`num_envs=1`, tensors with a leading 1)."""
        ...


def load_policy(checkpoint: Path, **kwargs) -> Policy:
    """The policy of a checkpoint folder: its config.json names the class ("kind": "module:Class").

    Raises:
        CheckpointError: the folder is not a checkpoint, or its class cannot be found.
    """
    kind = str(checkpoint_config(checkpoint).get("kind", ""))
    module, _, name = kind.partition(":")
    try:
        policy_class = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise CheckpointError(
            f"{checkpoint}: its policy is {kind!r}, which cannot be imported ({error}); it must read 'module:Class', and the "
            "module must be installed"
        ) from error
    return policy_class(checkpoint, **kwargs)
