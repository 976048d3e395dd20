"""What evaluation asks of a policy, and where policies come from."""

import importlib
import json
from dataclasses import dataclass
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


class PolicyError(ValueError):
    """A policy that cannot be made."""


@dataclass(frozen=True)
class PolicySource:
    """Where a policy comes from: a checkpoint of the baselines, or a class or address of one's own."""

    checkpoint: Path | None = None
    policy: str | None = None
    """"module:Class", or the address of a server ("http://localhost:8000")"""
    kwargs: str = "{}"
    """arguments of the class, as json"""

    def make(self) -> Policy:
        """The policy.

        Raises:
            CheckpointError: the folder is not a checkpoint, or its class cannot be found.
            PolicyError: the class cannot be found, or not be made.
        """
        kwargs = json.loads(self.kwargs)
        if self.checkpoint is not None:
            return load_policy(self.checkpoint, **kwargs)
        name = str(self.policy)
        if name.startswith(("http://", "https://")):
            from .remote_policy import RemotePolicy

            return RemotePolicy(name, **kwargs)
        try:
            return import_name(name)(**kwargs)
        except Exception as error:  # a policy is anybody's code
            raise PolicyError(
                f"{name} cannot be made ({type(error).__name__}: {error}); give module:Class, importable from here, and its "
                "arguments as --policy-kwargs"
            ) from error


def load_policy(checkpoint: Path, **kwargs) -> Policy:
    """The policy of a checkpoint folder: its config.json names the class ("kind": "module:Class").

    Raises:
        CheckpointError: the folder is not a checkpoint, or its class cannot be found.
    """
    kind = str(checkpoint_config(checkpoint).get("kind", ""))
    try:
        policy_class = import_name(kind)
    except (ImportError, AttributeError, ValueError) as error:
        raise CheckpointError(
            f"{checkpoint}: its policy is {kind!r}, which cannot be imported ({error}); it must read 'module:Class', and the "
            "module must be installed"
        ) from error
    return policy_class(checkpoint, **kwargs)


def import_name(name: str) -> Any:
    """What "module:Name" stands for."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)
