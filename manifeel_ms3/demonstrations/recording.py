"""Shared by everything that records: a trajectory file's json, the episodes of earlier runs, and the state of a worker."""

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym

from manifeel_ms3.tasks.registry import make_env, task_spec

from .formats.maniskill_h5 import DemonstrationError, Episode, finished_episodes, read_header, write_episode

PACKAGES = ("manifeel-ms3", "mani-skill", "sapien", "torch")
"""Packages whose versions a trajectory file names: the outcome of an episode can depend on them."""


def make_header(env_id: str, env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """The json of a trajectory file, but for its episodes.

    The environment's id has gymnasium's form "module:id", so that ManiSkill's tools import the module that registers it. The
    render backend is left out, because it is a choice of the machine at hand.

    Args:
        env_id: Id of the task.
        env_kwargs: Arguments of the environment.

    Raises:
        UnknownNameError: The task is not registered.
    """
    spec = task_spec(env_id)
    kept = {name: value for name, value in env_kwargs.items() if name != "render_backend"}
    return dict(
        env_info=dict(env_id=spec.gym_id, env_kwargs=kept, max_episode_steps=spec.max_episode_steps),
        source_type="scripted",
        source_desc="manifeel_ms3 demonstrator that acts within the policy's controller and on what the pads feel",
        versions={name: version(name) for name in PACKAGES},
        revision=spec.revision,
    )


def finished_before(path: Path, header: dict[str, Any]) -> tuple[dict[int, dict], set[int]]:
    """Json entries of the episodes by seed, and the failed seeds, that earlier runs have left in a trajectory file.

    Args:
        path: The trajectory file; nothing is left if it does not exist.
        header: The json that this run writes.

    Raises:
        DemonstrationError: The file was recorded with other arguments or with another revision of the task.
    """
    failed: set[int] = set()
    if path.is_file():
        before = read_header(path)
        for name in ("env_info", "revision"):
            if before.get(name, header[name]) != header[name]:
                raise DemonstrationError(
                    f"{path} was recorded with {name}={before[name]}, this run asks for {header[name]}; give another --out, or "
                    "delete the file"
                )
        failed = set(before.get("failed_seeds", []))
    return finished_episodes(path), failed


@dataclass(frozen=True)
class Recorder:
    """State of a worker process that records: one environment, and the file that its episodes belong to."""

    env: gym.Env
    env_id: str
    path: Path
    """Trajectory file beside which finished episodes are written."""

    def write(self, episode: Episode) -> dict[str, Any]:
        """Write an episode, and return its entry in the json."""
        write_episode(self.path, episode)
        return episode.info | dict(episode_seed=episode.seed)


def make_recorder(env_id: str, env_kwargs: dict[str, Any], path: Path) -> Recorder:
    """Make the state of a worker process."""
    return Recorder(make_env(env_id, **env_kwargs), env_id, path)
