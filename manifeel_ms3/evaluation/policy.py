"""The interface of a policy that can be evaluated, and the places that policies come from."""

import importlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from manifeel_ms3 import plugins
from manifeel_ms3.errors import InvalidArgumentError, UnknownNameError

from .checkpoint_config import CheckpointError, checkpoint_config


class Policy(Protocol):
    """Any object with these two methods can be evaluated."""

    def reset(self) -> None:
        """Begin a new episode: forget everything, and seed all randomness anew."""
        ...

    def act(self, obs: dict[str, Any]) -> np.ndarray:
        """Action (A,) in [-1, 1] for the environment's observation (`num_envs=1`, tensors with a leading 1)."""
        ...


class PolicyError(InvalidArgumentError):
    """A policy of the user's own cannot be made."""


@dataclass(frozen=True)
class PolicySource:
    """The place that a policy comes from: a checkpoint, or a class or server that the user names on the command line."""

    checkpoint: Path | None = None
    """Checkpoint folder of a registered policy."""
    policy: str | None = None
    """Importable class ("module:Class"), or address of a server ("http://localhost:8000"). It must come from the command
    line, never from a file, since it is imported."""
    kwargs: str = "{}"
    """Keyword arguments of the policy, as json."""

    def make(self) -> Policy:
        """Make the policy.

        Raises:
            CheckpointError: The folder is not a checkpoint, or its policy is not registered.
            PolicyError: The class cannot be found, or its constructor fails.
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
        except Exception as error:  # the constructor is anybody's code
            raise PolicyError(
                f"{name} cannot be made ({type(error).__name__}: {error}); give module:Class, importable from here, and its "
                "arguments as --policy-kwargs"
            ) from error


def load_policy(checkpoint: Path, **kwargs: Any) -> Policy:
    """The policy of a checkpoint folder, whose config.json names it as it is registered in `manifeel.policies`.

    Args:
        checkpoint: Folder with config.json and weights.
        kwargs: Arguments of the policy that replace the checkpoint's own, such as `inference_steps`.

    Raises:
        CheckpointError: The folder is not a checkpoint, or names no registered policy.
        PluginError: The policy does not import.
    """
    config = checkpoint_config(checkpoint)
    if "policy_name" not in config:
        raise CheckpointError(
            f"{checkpoint} does not name a registered policy: its config.json has no policy_name, because it was written "
            "before policies were registered by name, or by another program; train the policy again"
        )
    try:
        plugin = plugins.load(plugins.POLICIES, str(config["policy_name"]))
    except UnknownNameError as error:
        raise CheckpointError(
            f"the policy of {checkpoint} is unknown: {error}; install the package that registers it"
        ) from error
    return plugin.load(checkpoint, **kwargs)


def import_name(name: str) -> Any:
    """The object that "module:Name" stands for.

    Only names that the user gives on the command line are imported, never a name that a file holds.
    """
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)
