"""A trained policy in the form that evaluation needs: it takes an environment's observation and returns one action."""

import typing
from collections import deque
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mani_skill.utils import common

from manifeel_ms3.evaluation.checkpoint_config import CheckpointError, checkpoint_config

from .checkpoint import WEIGHTS, load_weights, read_tensors, require_fit
from .observation import TAXEL_SHAPE, ObservationSpec, observation_spec, prepare
from .policy import VisuotactilePolicy

MAX_SETTING = 1_000_000
"""Largest number that a policy's settings may hold; the paper's largest is 2048, so that a checkpoint's config asks for no
tables of any size."""


def build_policy(config: dict[str, Any], policy_class: type[VisuotactilePolicy]) -> VisuotactilePolicy:
    """The policy of a checkpoint's config, with untrained weights.

    Raises:
        CheckpointError: The config is not one of this policy.
    """
    try:
        return policy_class(_from_json(policy_class.Config, config["policy"]), spec_of(config), config["action_dim"])
    except Exception as error:  # the config is anybody's
        raise CheckpointError(
            f"config is not one of the policy {policy_class.name!r} ({error!r}); evaluate it with the code it was trained with"
        ) from error


def _from_json(cls: type, value: Any) -> Any:
    """A dataclass, and the dataclasses that it contains, from the dict that `as_json` made."""
    if is_dataclass(cls):
        types = typing.get_type_hints(cls)
        if unknown := set(value) - {f.name for f in fields(cls)}:
            raise TypeError(f"{cls.__name__} has no {sorted(unknown)}")
        return cls(**{name: _from_json(types[name], part) for name, part in value.items()})
    numbers = value if isinstance(value, list) else [value]
    if any(isinstance(number, int | float) and not abs(number) <= MAX_SETTING for number in numbers):
        raise ValueError(f"{value} is beyond {MAX_SETTING}")
    return tuple(value) if typing.get_origin(cls) is tuple else value


def spec_of(config: dict[str, Any]) -> ObservationSpec:
    """The observations of a policy, from its training settings or a checkpoint's config."""
    cameras, pads = tuple(config["cameras"]), tuple(config["tactile_sensors"])
    rows, columns = config.get("taxel_shape", TAXEL_SHAPE)
    sizes = config["image_size"], config["tactile_image_size"]
    return observation_spec(config["obs_mode"], cameras, pads, *sizes, (rows, columns), config["pose"])


class PolicyAgent:
    """Executes `action_horizon` actions of a prediction, then predicts again from the last `obs_horizon` observations.

    Args:
        checkpoint: Folder with config.json and model.safetensors.
        policy_class: Class of the policy.
        inference_steps: Number of generation steps; that of the training settings if None.
        seed: Seed of the sampled noise; `reset` seeds it again, so that an episode depends on its observations alone.
        device: Device of the policy.

    Raises:
        CheckpointError: The checkpoint is missing, broken, or not one of this policy.
    """

    def __init__(
        self,
        checkpoint: Path,
        policy_class: type[VisuotactilePolicy],
        inference_steps: int | None = None,
        seed: int = 0,
        device: str = "cpu",
    ):
        self.config = checkpoint_config(checkpoint)
        weights = read_tensors(Path(checkpoint) / WEIGHTS)
        try:
            with torch.device("meta"):  # takes no memory, whatever size of network the config asks for
                described = build_policy(self.config, policy_class)
        except CheckpointError as error:
            raise CheckpointError(f"{checkpoint}: {error}") from error
        require_fit(described, weights, checkpoint)
        self.policy = build_policy(self.config, policy_class).to(device).eval()
        load_weights(self.policy, weights, checkpoint)
        self.device, self.seed = torch.device(device), seed
        steps = inference_steps or self.config.get("inference_steps")
        if not isinstance(steps, int) or steps < 1:
            raise CheckpointError(f"{checkpoint}: inference_steps={steps!r} must be a positive whole number")
        self.inference_steps = steps
        self.reset()

    def reset(self) -> None:
        """Forget past observations before an episode."""
        self._window: deque[dict[str, np.ndarray]] = deque(maxlen=self.policy.config.obs_horizon)
        self._queue: deque[np.ndarray] = deque()
        self._generator = torch.Generator(self.device).manual_seed(self.seed)

    def act(self, obs: dict[str, Any]) -> np.ndarray:
        """The action (A,) for the observation of an environment with `num_envs=1`."""
        self._window.append(self._prepared(obs))
        if not self._queue:
            window = [self._window[0]] * (self.policy.config.obs_horizon - len(self._window)) + list(self._window)
            batch = {
                key: torch.as_tensor(np.stack([step[key] for step in window])[None], device=self.device) for key in window[0]
            }
            self._queue.extend(self.policy.sample(batch, self.inference_steps, self._generator)[0].cpu().numpy())
        return self._queue.popleft().clip(-1.0, 1.0)

    def _prepared(self, obs: dict[str, Any]) -> dict[str, np.ndarray]:
        prepared = {}
        for key in self.policy.spec.keys:
            value: Any = obs
            for part in key.split("/"):
                value = value[part]
            prepared[key] = prepare(key, common.to_numpy(value), self.policy.spec)[0]
        return prepared
