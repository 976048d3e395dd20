"""Demonstrations in memory, and sequences of them by index arithmetic."""

from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
import torch

from manifeel_ms3.demonstrations import DemonstrationError
from manifeel_ms3.demonstrations.formats import format_of
from manifeel_ms3.progress import progress_bar

from .observation import ObservationSpec, prepare

Episode = dict[str, np.ndarray]


def read_episodes(files: Iterable[Path], env_id: str, spec: ObservationSpec, num_demos: int | None) -> list[Episode]:
    """Episodes of a task: what a policy sees (T + 1, ...), and "actions" (T, A).

    Args:
        files: trajectory files, LeRobot datasets, zarr stores of the paper's layout.
        num_demos: how many to take, over all files; None: all.

    Raises:
        DemonstrationError: a file is missing, broken, of another task or obs mode, or there are too few episodes.
    """
    files, episodes = list(files), []
    formats = [format_of(file) for file in files]
    held = [known.count(file) for file, known in zip(files, formats, strict=True)]
    wanted = sum(held) if num_demos is None else num_demos
    if not 0 < wanted <= sum(held):
        raise DemonstrationError(f"{wanted} demonstrations are wanted, the files hold {held}; record more, or ask for fewer")
    with progress_bar() as bar:
        for file, count, known in zip(files, held, formats, strict=True):
            left = min(count, wanted - len(episodes))
            if left == 0:
                break
            track = partial(bar.track, description=f"reading {file.name}")
            for episode in known.read(file, spec.keys, num=left, progress=track, env_id=env_id):
                episodes.append({key: prepare(key, episode[key], spec) for key in spec.keys} | dict(actions=episode["actions"]))
    return episodes


class SequenceDataset:
    """All frames of all episodes on one device, images as uint8; a sample is an index into them.

    A sample at step t holds the observations t - obs_horizon + 1 .. t and the actions that begin with the first of them,
    `pred_horizon` in all. Before the start and after the end, the first and last are repeated.
    """

    def __init__(
        self, episodes: list[Episode], spec: ObservationSpec, obs_horizon: int, pred_horizon: int, device: torch.device
    ):
        self.spec, self.device, self.num_episodes = spec, device, len(episodes)
        lengths = np.array([len(episode["actions"]) for episode in episodes])
        self.actions = self._load([episode["actions"] for episode in episodes])  # (S, A)
        # the observation after the last action has no action: it is left out, so that frames and actions share an index
        self.observations = {key: self._load([episode[key][:-1] for episode in episodes]) for key in spec.keys}
        ends = np.cumsum(lengths)
        starts = ends - lengths
        step = np.arange(ends[-1])
        episode_of = np.repeat(np.arange(len(lengths)), lengths)
        self._place = torch.as_tensor(np.stack([episode_of, step - starts[episode_of]], axis=1))
        first, last = starts[episode_of][:, None], ends[episode_of][:, None] - 1
        begin = step[:, None] - obs_horizon + 1
        self._obs_index = torch.as_tensor(np.clip(begin + np.arange(obs_horizon), first, last), device=device)
        self._action_index = torch.as_tensor(np.clip(begin + np.arange(pred_horizon), first, last), device=device)

    def _load(self, parts: list[np.ndarray]) -> torch.Tensor:
        return torch.as_tensor(np.concatenate(parts), device=self.device)

    def names(self, index: torch.Tensor) -> str:
        """Where samples are in the files, for messages."""
        episode, step = self._place[index.cpu()].T
        return ", ".join(f"episode {e} step {t}" for e, t in zip(episode.tolist(), step.tolist(), strict=True))

    def __len__(self) -> int:
        return len(self._obs_index)

    def sample(self, index: torch.Tensor) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """Observations {key: (B, obs_horizon, ...)} and actions (B, pred_horizon, A) at sample numbers `index` (B,)."""
        obs_index = self._obs_index[index]
        return {key: frames[obs_index] for key, frames in self.observations.items()}, self.actions[self._action_index[index]]
