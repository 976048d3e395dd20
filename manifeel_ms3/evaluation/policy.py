"""What evaluation asks of a policy, and where policies come from."""

import importlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from manifeel_ms3 import plugins
from manifeel_ms3.errors import ManifeelError, UnknownNameError

from .checkpoint_config import CheckpointError, checkpoint_config


class Policy(Protocol):
    """Any object with these two methods can be evaluated."""

    def reset(self) -> None:
        """A new episode begins: forget everything, reseed all randomness."""
        ...

    def act(self, obs: dict[str, Any]) -> np.ndarray:
        """Action (A,) in [-1, 1] for the environment's observation (`num_envs=1`, tensors with a leading 1)."""
        ...


class PolicyError(ManifeelError, ValueError):
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


def load_policy(checkpoint: Path, **kwargs: Any) -> Policy:
    """The policy of a checkpoint folder, whose config.json names it as it is registered in `manifeel.policies`.

    Raises:
        CheckpointError: The folder is not a checkpoint, or names no registered policy.
        PluginError: The policy does not import.
    """
    config = checkpoint_config(checkpoint)
    if "policy_name" not in config:
        raise CheckpointError(
            f"{checkpoint} does not name its policy: it was written by manifeel-ms3 0.1.0 or is of another kind; train it again"
        )
    try:
        plugin = plugins.load(plugins.POLICIES, str(config["policy_name"]))
    except UnknownNameError as error:
        raise CheckpointError(f"{checkpoint}: its policy is unknown: {error}; install the package that registers it") from error
    return plugin.load(checkpoint, **kwargs)


def import_name(name: str) -> Any:
    """What "module:Name" stands for."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)
