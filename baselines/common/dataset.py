"""Demonstrations in memory, the sequences of their steps that training draws, and the order in which it draws them."""

from collections.abc import Iterable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from manifeel_ms3.demonstrations import DemonstrationError
from manifeel_ms3.demonstrations.formats import Demonstration, format_of
from manifeel_ms3.demonstrations.formats.demonstration_format import require_form
from manifeel_ms3.evaluation.variant import BACKENDS, OF_A_RECORDER, SENSING
from manifeel_ms3.nested_settings import differing
from manifeel_ms3.progress import progress_bar

from .memory import return_freed_memory
from .observation import POSE, ObservationSpec, prepare
from .pose_targets import POSITION, as_targets


def read_episodes(files: Iterable[Path], env_id: str, spec: ObservationSpec, num_demos: int | None) -> list[Demonstration]:
    """Episodes of a task: observations as a policy takes them, (T + 1, ...), and "actions", (T, A).

    Args:
        files: Trajectory files, LeRobot datasets, and zarr stores of the paper's layout.
        env_id: Environment id of the task.
        spec: Observations of the policy.
        num_demos: Number of episodes over all files; all episodes if None.

    Raises:
        DemonstrationError: A file is missing, broken, of another task or observation mode, holds NaN or arrays of another shape
            than the first episode, or there are too few episodes.
    """
    files, episodes = list(files), []
    formats = [format_of(file) for file in files]
    held = [known.count(file) for file, known in zip(files, formats, strict=True)]
    wanted = sum(held) if num_demos is None else num_demos
    if not 0 < wanted <= sum(held):
        raise DemonstrationError(
            f"{wanted} demonstrations are wanted, but the files hold {held}; record more, or ask for fewer"
        )
    with progress_bar() as bar:
        for file, count, known in zip(files, held, formats, strict=True):
            left = min(count, wanted - len(episodes))
            if left == 0:  # the file holds no episode, or those before it are enough
                continue
            track = partial(bar.track, description=f"reading {file.name}")
            recorded = known.read(file, spec.keys, num=left, progress=track, env_id=env_id)
            # unlike a loop, `map` holds no episode while it reads; episodes come first, so that the bar reaches its end
            episodes.extend(map(partial(_prepared, spec, file), recorded, range(left)))
            _require_same_shapes(file, episodes[0], episodes[-left:])
    return episodes


def _prepared(spec: ObservationSpec, file: Path, recorded: Demonstration, number: int) -> Demonstration:
    """Episode `number` of a file as networks take it.

    Raises:
        DemonstrationError: An observation has another form than networks take, or a number is not finite.
    """
    for key in spec.keys:
        require_form(f"{file}: {key!r} of episode {number}, counted from 0,", key, recorded[key].shape)
    episode = {key: prepare(key, recorded[key], spec) for key in spec.keys}
    episode["actions"] = recorded["actions"].astype(np.float32)  # other programs record other types, too
    for key in ("actions", POSE, *spec.force_fields):
        finite = np.isfinite(episode[key]).reshape(len(episode[key]), -1).all(1)
        if not finite.all():  # the ranges by which all demonstrations are scaled would not be finite either
            raise DemonstrationError(
                f"{file}: {key!r} of episode {number}, counted from 0, is NaN or infinite at step {finite.argmin()}; record it "
                "again, or leave the file out"
            )
    return episode


def _require_same_shapes(file: Path, first: Demonstration, episodes: list[Demonstration]) -> None:
    """Check that the episodes of a file have arrays of the same shapes as the first episode of all files.

    Raises:
        DemonstrationError: They do not.
    """
    for number, episode in enumerate(episodes):
        for key, values in episode.items():
            if (found := values.shape[1:]) != (expected := first[key].shape[1:]):
                raise DemonstrationError(
                    f"{file}: {key!r} of episode {number}, counted from 0, has the shape {found} at a step, and {expected} in "
                    "the first episode; train on files that were recorded with the same sensors and control mode"
                )


def recorded_task(files: Iterable[Path]) -> str:
    """Id of the task that the episodes are of, from the first file that names one.

    Raises:
        DemonstrationError: No file names one, or a file is broken.
    """
    files = list(files)
    for file in files:
        read = format_of(file).env_id
        if read is not None and (found := read(file)) is not None:
            return found
    raise DemonstrationError(f"{', '.join(map(str, files))}: no file says of which task it is; give --env-id")


def recorded_env_kwargs(files: Iterable[Path]) -> dict[str, Any]:
    """The arguments of the task with which demonstrations were recorded, such as its lighting or fit; evaluation uses them.

    LeRobot datasets of other sources hold no such arguments. For zarr stores of the paper's own data, they are the paper's
    units.

    Raises:
        DemonstrationError: Two files were recorded with different arguments.
    """
    readers = [(file, format_of(file).env_kwargs) for file in files]
    recorded = [(file, read(file)) for file, read in readers if read is not None]
    known = [(file, _of_task(arguments)) for file, arguments in recorded if arguments is not None]
    for (first, expected), (second, found) in pairwise(known):
        for name, one, other in differing(dict.fromkeys(found) | expected, dict.fromkeys(expected) | found):
            raise DemonstrationError(
                f"{first} was recorded with {name}={one!r}, {second} with {name}={other!r}; train on files "
                "that were recorded with the same arguments of the task"
            )
    return known[0][1] if known else {}


def _of_task(recorded: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in recorded.items() if name not in (*SENSING, *BACKENDS, *OF_A_RECORDER)}


class SequenceDataset:
    """All frames of all episodes on one device, images as uint8; a sample is an index into these frames.

    A sample at step t holds the observations t - obs_horizon + 1 to t, and the `pred_horizon` actions that begin with the first
    of them. Before the start of an episode its first step is repeated, after its end the last step. No sample begins so late
    that an executed action would be such a repetition, as in the paper's public code: an episode of T steps has T -
    action_horizon + 1 samples. An episode that is shorter than `action_horizon` has one sample.

    Args:
        episodes: Episodes from `read_episodes`. The list is emptied, so that an episode leaves the memory once it is copied.
        spec: Observations of the policy.
        obs_horizon: Number of observations of a sample.
        pred_horizon: Number of actions of a sample.
        action_horizon: Number of actions that are executed from the last observation on.
        device: Device that holds the frames.
        targets_of: Control mode whose actions are turned into targets (`pose_targets`); None if samples hold actions.
    """

    def __init__(
        self,
        episodes: list[Demonstration],
        spec: ObservationSpec,
        obs_horizon: int,
        pred_horizon: int,
        action_horizon: int,
        device: torch.device,
        targets_of: str | None = None,
    ):
        self.spec, self.device, self.num_episodes, self._targets_of = spec, device, len(episodes), targets_of
        if targets_of:
            for episode in episodes:
                episode["actions"] = as_targets(episode[POSE], episode["actions"], targets_of)
        lengths = np.array([len(episode["actions"]) for episode in episodes])
        self.observations = {name: torch.as_tensor(a, device=device) for name, a in _joined(episodes, spec.keys).items()}
        self.actions = self.observations.pop("actions")  # (S, A)
        ends = np.cumsum(lengths)
        starts = ends - lengths
        samples = np.maximum(lengths - action_horizon + 1, 1)  # of each episode
        episode_of = np.repeat(np.arange(len(lengths)), samples)
        step = np.arange(len(episode_of)) + (starts - np.cumsum(samples) + samples)[episode_of]
        self._place = torch.as_tensor(np.stack([episode_of, step - starts[episode_of]], axis=1))
        first, last = starts[episode_of][:, None], ends[episode_of][:, None] - 1
        begin = step[:, None] - obs_horizon + 1
        self._obs_index = torch.as_tensor(np.clip(begin + np.arange(obs_horizon), first, last), device=device)
        self._action_index = torch.as_tensor(np.clip(begin + np.arange(pred_horizon), first, last), device=device)

    def names(self, index: torch.Tensor) -> str:
        """The episodes and steps of samples, for messages."""
        episode, step = self._place[index.cpu()].T
        return ", ".join(f"episode {e} step {t}" for e, t in zip(episode.tolist(), step.tolist(), strict=True))

    def __len__(self) -> int:
        return len(self._obs_index)

    def sample(self, index: torch.Tensor) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """The observations {key: (B, obs_horizon, ...)} and actions (B, pred_horizon, A) of the samples `index` (B,)."""
        obs_index = self._obs_index[index]
        return {key: frames[obs_index] for key, frames in self.observations.items()}, self._actions_of(index)

    @property
    def actions_to_fit(self) -> torch.Tensor:
        """All actions (S, A), or the targets (N, pred_horizon, A) of all samples."""
        return self._actions_of(torch.arange(len(self))) if self._targets_of else self.actions

    def _actions_of(self, index: torch.Tensor) -> torch.Tensor:
        actions = self.actions[self._action_index[index]]
        if self._targets_of:
            seen_from = self.observations[POSE][self._obs_index[index, -1]]
            actions[..., POSITION] -= seen_from[:, None, POSITION]
        return actions


def _joined(episodes: list[Demonstration], keys: list[str]) -> Demonstration:
    """The "actions" and the observations `keys` (S, ...) at the steps of all episodes, one episode after the other.

    No action follows the last observation of an episode, so it is left out and observations and actions share an index.
    """
    steps = sum(len(episode["actions"]) for episode in episodes)
    forms = {name: (episodes[0][name].shape[1:], episodes[0][name].dtype) for name in ("actions", *keys)}
    joined = {name: np.empty((steps, *shape), dtype) for name, (shape, dtype) in forms.items()}
    begin = 0
    while episodes:
        episode = episodes.pop(0)
        end = begin + len(episode["actions"])
        for name, values in joined.items():
            np.concatenate([episode[name][: end - begin]], out=values[begin:end])  # an assignment would broadcast other shapes
        begin = end
        del episode
        return_freed_memory()
    return joined


class SampleOrder:
    """Indices of samples, in an order that is shuffled anew for each epoch.

    Args:
        num_samples: Number of samples of an epoch.
        seed: Seed of the order.
    """

    def __init__(self, num_samples: int, seed: int):
        self.num_samples = num_samples
        self._generator = torch.Generator().manual_seed(seed)
        self._left = torch.empty(0, dtype=torch.long)

    def take(self, count: int) -> torch.Tensor:
        """The next `count` indices; those left of an epoch are followed by the first of the next."""
        while len(self._left) < count:
            self._left = torch.cat([self._left, torch.randperm(self.num_samples, generator=self._generator)])
        taken, self._left = self._left[:count], self._left[count:]
        return taken

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The indices left of this epoch, and the state of the random number generator."""
        return dict(order=self._left, order_random=self._generator.get_state())

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Continue from a state of `state_dict`; further entries are ignored."""
        self._left = state["order"]
        self._generator.set_state(state["order_random"])
