"""The interface of a policy that can be evaluated, and the places that policies come from."""

import importlib
import importlib.util
import json
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from manifeel_ms3 import plugins
from manifeel_ms3.arguments import by_name, meant
from manifeel_ms3.errors import InvalidArgumentError, MachineError, ManifeelError, ServerError, UnknownNameError
from manifeel_ms3.files import file_hash
from manifeel_ms3.typed_modules import look_in_working_folder

from .checkpoint_config import CheckpointError, checkpoint_config, hash_of_all_files
from .redaction import redacted

INFERENCE_STEPS = "inference_steps"
"""Argument of a checkpoint's policy, and entry of its configuration: the number of generation steps of an action chunk."""
STEP_TIMEOUT = 60.0
"""Longest time in s that a policy may take for one action if no other time is given; set once, not tuned."""


class Policy(Protocol):
    """Any object with these two methods can be evaluated. It may have any of the members of `EpisodePolicy`, too."""

    def reset(self) -> None:
        """Begin a new episode: forget everything, and seed all randomness anew."""
        ...

    def act(self, obs: dict[str, Any]) -> np.ndarray:
        """Action (A,) or (1, A) in the task's action space for its observation (`num_envs=1`, tensors with a leading 1)."""
        ...


class EpisodePolicy(ABC):
    """A policy with every member that evaluation uses. The optional ones have the defaults that are given here.

    A policy may derive from this class, but need not: `with_defaults` adds what another policy lacks.
    """

    waited: float = 0.0
    """Time in s that the last call of `act` waited for other episodes, which does not count as time of inference."""
    limits_itself: bool = False
    """Whether the policy itself ends an answer that takes too long, so that the time limit of a step is not applied to it."""

    @property
    def looks(self) -> bool:
        """Whether the next call of `act` needs the cameras' images, which are otherwise left out of its observation."""
        return True

    def begin_episode(self, seed: int) -> None:
        """Begin the episode of a seed; evaluation calls this method instead of `reset`."""
        self.reset()

    @abstractmethod
    def reset(self) -> None:
        """Begin a new episode: forget everything, and seed all randomness anew."""

    @abstractmethod
    def act(self, obs: dict[str, Any]) -> np.ndarray:
        """Action (A,) or (1, A) in the task's action space for its observation (`num_envs=1`, tensors with a leading 1)."""


class PolicyOfPart(EpisodePolicy):
    """A policy whose episode is in the hands of a part of it, to which it passes all calls on."""

    _part: EpisodePolicy

    @property
    def looks(self) -> bool:
        return self._part.looks

    def reset(self) -> None:
        self._part.reset()

    def begin_episode(self, seed: int) -> None:
        self._part.begin_episode(seed)

    def act(self, obs: dict[str, Any]) -> np.ndarray:
        return self._part.act(obs)


def with_defaults(policy: Policy) -> EpisodePolicy:
    """The policy itself if it is an `EpisodePolicy`; otherwise the policy with the defaults of the members that it lacks."""
    return policy if isinstance(policy, EpisodePolicy) else _WithDefaults(policy)


class _WithDefaults(EpisodePolicy):
    def __init__(self, policy: Policy):
        self._policy = policy

    @property
    def waited(self) -> float:
        return getattr(self._policy, "waited", EpisodePolicy.waited)

    @property
    def limits_itself(self) -> bool:
        return getattr(self._policy, "limits_itself", EpisodePolicy.limits_itself)

    @property
    def looks(self) -> bool:
        return getattr(self._policy, "looks", super().looks)

    def begin_episode(self, seed: int) -> None:
        getattr(self._policy, "begin_episode", super().begin_episode)(seed)

    def reset(self) -> None:
        self._policy.reset()

    def act(self, obs: dict[str, Any]) -> np.ndarray:
        return self._policy.act(obs)


@dataclass(frozen=True)
class PolicyRequest:
    """The request of one episode for actions, to a policy that answers several episodes at once."""

    seed: int
    """Seed of the episode."""
    step: int
    """Number of control steps before this one."""
    observation: dict[str, np.ndarray]
    """Arrays by name, as the policy takes them."""


Ask = Callable[[PolicyRequest], np.ndarray]
"""Function that sends a request to the policy and returns its answer, an array whose form the policy and its part beside the
episode agree on."""


class BatchPolicy(Protocol):
    """A policy of which one object answers the requests of all episodes in batches: one network on one device.

    The object keeps no state of an episode. This state is kept by the policy's part beside the episode, which
    `make_episode_part` makes in the process that simulates. A registered policy (`manifeel.policies`) may be a `BatchPolicy`.
    """

    make_episode_part: Callable[[Ask], Policy]
    """Function that makes the part of the policy that runs beside an episode, a `Policy`. It takes the function to which this
    part gives its requests, and is pickled."""
    batch_size: int
    """Largest number of requests that are answered together."""

    def answer(self, requests: list[PolicyRequest]) -> list[np.ndarray]:
        """One answer for each request; it depends on this request only, not on the others in the batch."""
        ...


class PolicyError(InvalidArgumentError):
    """A class or server that the user named as the policy cannot be made."""


class PolicyUnavailableError(ServerError):
    """The policy cannot be reached through no fault of its own: its server is not running, or does not keep episodes apart.

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

    device: str | None = None
    """Device that computes a checkpoint's policy, such as "cpu" or "cuda"."""
    batch_size: int | None = None
    """Number of episodes that a checkpoint's policy answers together."""
    answer_timeout: float = STEP_TIMEOUT
    """Longest time in s that a server may take for an answer."""

    @property
    def is_shared(self) -> bool:
        """Whether one object may answer all episodes, as for a checkpoint; other policies are made in each process."""
        return self.checkpoint is not None

    def make(self) -> Policy:
        """Make the policy.

        Raises:
            CheckpointError: The folder is not a checkpoint, or its policy is not registered.
            PolicyError: The class cannot be found, its constructor fails, or it does not take one of the arguments.
        """
        kwargs = json.loads(self.kwargs)
        if self.checkpoint is not None:
            try:
                return load_policy(self.checkpoint, device=self.device, batch_size=self.batch_size, **kwargs)
            except TypeError as error:  # it does not take one of the arguments
                raise PolicyError(f"{self.checkpoint} cannot be made with --policy-kwargs {self.kwargs} ({error})") from error
        name = str(self.policy)
        try:
            if self.is_server:
                from .remote_policy import RemotePolicy

                return RemotePolicy(name, **dict(timeout=self.answer_timeout) | kwargs)
            return import_name(name)(**kwargs)
        except ManifeelError:
            raise
        except Exception as error:  # the constructor may raise anything
            raise PolicyError(
                f"{redacted(name)} cannot be made ({type(error).__name__}: {error}); give module:Class, importable from here, "
                "and its arguments as --policy-kwargs, or the address of a server, which begins with http://"
            ) from error

    def as_in(self, result: dict[str, Any]) -> "PolicySource":
        """The policy as it acted in a result.

        A checkpoint's actions depend on its device, the size of its batches, the number of its generation steps and its other
        arguments; all are then those of the result. Any other policy stays as it is.

        Raises:
            MachineError: This machine does not have the device.
        """
        if self.checkpoint is None:
            return self
        recorded = {name: value for name, value in result["config"].items() if name == INFERENCE_STEPS}
        recorded |= by_name("policy_kwargs", result["config"].get("policy_kwargs", {}), '{"seed": 1}')
        kwargs = json.dumps(recorded | json.loads(self.kwargs))
        inference = result["inference"]
        return replace(self, kwargs=kwargs, device=checked_device(inference["device"]), batch_size=inference["batch_size"])

    @property
    def is_server(self) -> bool:
        """Whether the policy is the address of a server."""
        return str(self.policy).startswith(("http://", "https://"))

    def fingerprint(self) -> str | None:
        """SHA-256 of the checkpoint, or of the file with the class; None for a server, and where no such file is found."""
        if self.checkpoint is not None:
            return hash_of_all_files(self.checkpoint)
        if self.is_server:
            return None
        look_in_working_folder()
        try:
            spec = importlib.util.find_spec(str(self.policy).partition(":")[0])
            return file_hash(Path(spec.origin)) if spec and spec.origin else None
        except Exception:  # the search imports packages, which may fail; `make` names the fault
            return None


BATCH_SIZES = dict(cpu=1, cuda=16)
"""Numbers of episodes that a policy answers together if none is given. On one CPU core, larger batches of the paper's networks
take longer in the same proportion; a GPU computes 16 in the time of one."""


def checked_device(name: str | None) -> str:
    """Name of a torch device that this machine has: the given one; if none is given, a GPU if there is one, else the CPU.

    Raises:
        InvalidArgumentError: The name is not that of a device.
        MachineError: This machine does not have the device.
    """
    if name is None:
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError) as error:
        raise InvalidArgumentError(f"--device {name!r} is no device of torch; give cpu, cuda or cuda:1") from error
    try:
        torch.zeros(1, device=device)
    except Exception as error:  # torch's backends raise errors of many types
        reason = str(error).splitlines()[0]
        raise MachineError(
            f"--device {name} is not there ({reason}); give --device cpu, or install a build of torch that supports it"
        ) from error
    return name


def load_policy(checkpoint: Path, **kwargs: Any) -> Policy:
    """The policy of a checkpoint folder, whose config.json names it as it is registered in `manifeel.policies`.

    Args:
        checkpoint: Folder with config.json and weights.
        kwargs: Arguments of the policy: `device` and `batch_size`, and what replaces the checkpoint's own settings, such as
            `inference_steps`.

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
    """The object that a name such as "module:Name" stands for.

    Only names that the user gives on the command line are imported, never a name that a file holds.
    """
    look_in_working_folder()
    module, _, attribute = name.partition(":")
    imported = importlib.import_module(module)
    if not hasattr(imported, attribute):
        raise AttributeError(f"{module!r} has no {attribute!r}{meant(attribute, vars(imported))}")
    return getattr(imported, attribute)
