"""The interface of a policy that can be evaluated, and the places that policies come from."""

import importlib
import importlib.util
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from manifeel_ms3 import plugins
from manifeel_ms3.errors import InvalidArgumentError, ManifeelError, ServerError, UnknownNameError

from .checkpoint_config import CheckpointError, checkpoint_config, checkpoint_hash, file_hash
from .redaction import redacted


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


class PolicyUnavailableError(ServerError):
    """The policy cannot be asked, for a reason that is not its own: its server is not running, or does not keep episodes apart.

    It ends the evaluation. Any other error of a policy is its own fault and fails the episode.
    """


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
        try:
            if self.is_server:
                from .remote_policy import RemotePolicy

                return RemotePolicy(name, **kwargs)
            return import_name(name)(**kwargs)
        except ManifeelError:
            raise
        except Exception as error:  # the constructor is anybody's code
            raise PolicyError(
                f"{redacted(name)} cannot be made ({type(error).__name__}: {error}); give module:Class, importable from here, "
                "and its arguments as --policy-kwargs"
            ) from error

    @property
    def is_server(self) -> bool:
        """Whether the policy is the address of a server."""
        return str(self.policy).startswith(("http://", "https://"))

    def fingerprint(self) -> str | None:
        """SHA-256 of the checkpoint, or of the file with the class; None for a server, and where no such file is found."""
        if self.checkpoint is not None:
            return checkpoint_hash(self.checkpoint)
        if self.is_server:
            return None
        try:
            spec = importlib.util.find_spec(str(self.policy).partition(":")[0])
            return file_hash(Path(spec.origin)) if spec and spec.origin else None
        except Exception:  # packages are imported on the way; `make` names what is wrong
            return None


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
