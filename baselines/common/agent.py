"""A trained policy in the form that evaluation needs: it takes an environment's observation and returns one action."""

import typing
import warnings
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from manifeel_ms3.command_line import missing_extras_named
from manifeel_ms3.errors import MissingExtraError
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError, checkpoint_config
from manifeel_ms3.evaluation.policy import PolicyOfPart, PolicyRequest
from manifeel_ms3.tasks.registry import task_spec

from .action_chunks import ActionChunks
from .checkpoint import WEIGHTS, read_tensors, require_fit
from .observation import TAXEL_SHAPE, ObservationSpec, observation_spec
from .policy import VisuotactilePolicy

MAX_SETTING = 1_000_000
"""Largest number that the settings of a policy may hold, so that the config of a stranger's checkpoint cannot ask for networks
of any size; the largest number in the paper's settings is 2048."""
LAYERS = "mlp_blocks"
"""Setting that is a number of layers, of which each takes milliseconds and megabytes to make, as the entries of lists do."""
MAX_LAYERS = 1000
"""Largest number of layers, and of entries of a list, in such settings; the paper's lists have three."""

TRIAL_STEPS = 3
"""Number of generation steps of a trial, and number of trials, in which a traced network must agree with the original; set
once, not tuned."""
ROUNDING = 1e-4
"""Largest difference of an action, within [-1, 1], or of a target, in m and rad, between the traced and the original network.
Optimised convolutions round differently, which makes a difference of about 1e-6."""


def build_policy(config: dict[str, Any], policy_class: type[VisuotactilePolicy]) -> VisuotactilePolicy:
    """The policy of a checkpoint's config, with untrained weights.

    Raises:
        CheckpointError: The config does not describe this policy.
        MissingExtraError: Its networks need an optional dependency that is not installed.
    """
    try:
        with missing_extras_named():
            return policy_class(_from_json(policy_class.Config, config["policy"]), spec_of(config), config["action_dim"])
    except MissingExtraError:
        raise
    except Exception as error:  # the config may come from a stranger
        raise CheckpointError(
            f"config does not describe the policy {policy_class.name!r} ({error!r}); evaluate it with the code that trained it"
        ) from error


def _from_json(cls: type, value: Any) -> Any:
    """A dataclass, and the dataclasses that it contains, from the dict that `as_json` made."""
    if is_dataclass(cls):
        types = typing.get_type_hints(cls)
        if unknown := set(value) - {f.name for f in fields(cls)}:
            raise TypeError(f"{cls.__name__} has no fields {sorted(unknown)}")
        if (layers := value.get(LAYERS, 0)) > MAX_LAYERS:
            raise ValueError(f"{LAYERS}={layers} is larger than {MAX_LAYERS}")
        return cls(**{name: _from_json(types[name], part) for name, part in value.items()})
    numbers = value if isinstance(value, list) else [value]
    if len(numbers) > MAX_LAYERS:
        raise ValueError(f"a list of {len(numbers)} entries is longer than {MAX_LAYERS}")
    if any(isinstance(number, int | float) and not abs(number) <= MAX_SETTING for number in numbers):
        raise ValueError(f"{value} is larger than {MAX_SETTING}")
    return tuple(value) if typing.get_origin(cls) is tuple else value


def spec_of(config: dict[str, Any]) -> ObservationSpec:
    """The observations of a policy, from its training settings or a checkpoint's config."""
    cameras, pads = tuple(config["cameras"]), tuple(config["tactile_sensors"])
    rows, columns = config.get("taxel_shape", TAXEL_SHAPE)
    sizes = config["image_size"], config["tactile_image_size"]
    view = config.get("camera_view", "whole")
    return observation_spec(config["obs_mode"], cameras, pads, *sizes, (rows, columns), config["pose"], view)


class PolicyAgent(PolicyOfPart):
    """A trained policy: it answers several episodes at once, each from its last observations, or is the policy of one.

    An answer depends on its request only. The noise is drawn from the seed of the episode and the step. The network always
    computes a full batch, in which an episode has the place that its seed says, since matrix products round differently in
    batches of another size and at other places; what stands at the other places changes nothing.

    Args:
        checkpoint: Folder with config.json and model.safetensors.
        policy_class: Class of the policy.
        inference_steps: Number of generation steps; that of the training settings if None.
        seed: Seed of the noise, together with that of the episode.
        device: Device of the policy; the CPU if None.
        batch_size: Number of episodes that are answered together; 1 if None.

    Raises:
        CheckpointError: The checkpoint is missing, broken, or not one of this policy.
    """

    def __init__(
        self,
        checkpoint: Path,
        policy_class: type[VisuotactilePolicy],
        inference_steps: int | None = None,
        seed: int = 0,
        device: str | None = None,
        batch_size: int | None = None,
    ):
        self.config = checkpoint_config(checkpoint)
        weights = read_tensors(Path(checkpoint) / WEIGHTS)
        try:
            with torch.device("meta"):  # takes no memory, whatever size of network the config asks for
                described = build_policy(self.config, policy_class)
        except CheckpointError as error:
            raise CheckpointError(f"{checkpoint}: {error}") from error
        require_fit(described, weights, checkpoint)
        self.device, self.seed, self.batch_size = torch.device(device or "cpu"), seed, batch_size or 1
        self.policy = build_policy(self.config, policy_class).to(self.device).eval()
        self.policy.load_state_dict(weights)
        steps = self.config.get("inference_steps") if inference_steps is None else inference_steps
        settings = self.policy.config
        if not (isinstance(steps, int) and settings.can_generate_in(steps)):
            raise CheckpointError(f"{checkpoint}: inference_steps={steps!r} must be a whole number of {settings.step_range}")
        self.inference_steps = steps
        self.make_episode_part = partial(
            ActionChunks,
            self.policy.spec,
            settings.obs_horizon,
            limit=self.policy.action_normalizer.limit,
            targets_of=_control_mode(self.config, checkpoint) if settings.predicts_targets else None,
        )
        self._part = self.make_episode_part(lambda request: self.answer([request])[0])
        self._compiled = False

    def answer(self, requests: list[PolicyRequest]) -> list[np.ndarray]:
        """The actions (action_horizon, A) to execute next, for each request."""
        answers: dict[int, np.ndarray] = {}
        left = list(range(len(requests)))
        while left:
            places: dict[int, int] = {}
            for index in left:
                places.setdefault(requests[index].seed % self.batch_size, index)
            actions = self._predict({place: requests[index] for place, index in places.items()})
            answers |= {index: actions[place] for place, index in places.items()}
            left = [index for index in left if index not in answers]
        return [answers[index] for index in range(len(requests))]

    @torch.inference_mode()
    def _predict(self, requests: dict[int, PolicyRequest]) -> np.ndarray:
        """Actions (batch_size, action_horizon, A), of which only those at the places of requests count."""
        filling = next(iter(requests.values()))
        rows = [requests.get(place, filling) for place in range(self.batch_size)]
        batch = {
            key: torch.as_tensor(np.stack([row.observation[key] for row in rows])).to(self.device)
            for key in filling.observation
        }
        if not self._compiled:
            self._compiled = True
            self._compile(batch)
        generators = [_generator_of(self.seed, row.seed, row.step) for row in rows]
        return self.policy.sample(batch, self.inference_steps, generators).cpu().numpy()

    def _compile(self, batch: dict[str, torch.Tensor]) -> None:
        """Replace the network over actions by its trace, because a small network on a CPU spends half of its time in Python.

        The trace is used only if it computes the same actions.
        """
        if self.device.type != "cpu":
            return

        def sample() -> torch.Tensor:
            generators = [_generator_of(self.seed, place) for place in range(self.batch_size)]
            return self.policy.sample(batch, steps, generators)

        steps = TRIAL_STEPS if self.policy.config.can_generate_in(TRIAL_STEPS) else self.inference_steps
        network, given = self.policy.action_network, []
        try:
            with network.register_forward_pre_hook(lambda _, inputs: given.append(inputs)):
                expected = sample()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # torch warns of shapes in Python, which are always the same here
                traced: Any = torch.jit.trace(network, given[0], check_trace=False)
                self.policy.action_network = torch.jit.optimize_for_inference(traced)
            # the first calls optimise it further
            same = all(torch.allclose(sample(), expected, rtol=0.0, atol=ROUNDING) for _ in range(TRIAL_STEPS))
        except (RuntimeError, AttributeError, LookupError):  # not every network can be traced, or is called as a module
            same = False
        if not same:
            self.policy.action_network = network


def _control_mode(config: dict[str, Any], checkpoint: Path) -> str:
    """The control mode of the demonstrations that a checkpoint was trained on.

    Raises:
        CheckpointError: Its config does not say it.
    """
    env_id, env_kwargs = config.get("env_id"), config.get("env_kwargs")
    if not (isinstance(env_id, str) and isinstance(env_kwargs, dict)):
        raise CheckpointError(
            f"{checkpoint}: the config of a policy that predicts targets must say env_id and env_kwargs, and says {env_id!r} "
            f"and {env_kwargs!r}; the checkpoint is broken, use another one"
        )
    return task_spec(env_id).control_mode(env_kwargs)


def _generator_of(*numbers: int) -> torch.Generator:
    """A generator that some numbers seed; it is on the CPU, so that its noise is the same for every device."""
    (state,) = np.random.SeedSequence(numbers).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state) % 2**63)
