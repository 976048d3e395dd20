"""Give recorded episodes their observations: `python -m manifeel_ms3.demonstrations.render_observations states.h5 --out trajectory.h5`.

A file of states and actions is small, and is what one passes around. Its episodes are functions of seed and actions: played
again they are the same bit for bit, and so is what cameras and pads see. Each is checked against the states it was recorded
with. A run that was killed goes on where it stopped.
"""

import logging
import sys
from collections.abc import Callable
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tyro

from manifeel_ms3.command_line import run
from manifeel_ms3.progress import episode_counter
from manifeel_ms3.tasks.visuotactile_env import CAMERAS, SIDES

from .episode import run_episode
from .formats.maniskill_h5 import DemonstrationError, consolidate, open_trajectories, read_header, write_episode, write_index
from .record import already_there, make_header, worker, worker_env, worker_pool

log = logging.getLogger(__name__)


@dataclass
class Args:
    path: tyro.conf.Positional[Path]
    """trajectory file to take states and actions from"""
    out: Path
    """trajectory file to write"""
    obs_mode: str = "rgb+tacrgb+tacff"
    """what to observe"""
    cameras: tuple[str, ...] = CAMERAS
    """cameras to observe"""
    tactile_sensors: tuple[str, ...] = SIDES
    """pads to observe"""
    picture_size: int | None = None
    """pixels, of the cameras' sides; default: the task's 256"""
    workers: int = 1
    """processes"""
    num: int | None = None
    """episodes; default: all"""


def main(args: Args, on_episode: Callable[[], None] | None = None) -> Path:
    """Materialize, and return the file's path. `on_episode` is called after each episode, instead of a progress bar.

    Raises:
        DemonstrationError: an episode does not come out as it was recorded.
    """
    source = read_header(args.path)
    if args.path.resolve() == args.out.resolve():
        raise ValueError(f"--out {args.out} is the file that is read; give another")
    env_id = source["env_info"]["env_id"].rpartition(":")[2]
    env_kwargs: dict[str, Any] = source["env_info"]["env_kwargs"] | dict(
        obs_mode=args.obs_mode, cameras=list(args.cameras), tactile_sensors=list(args.tactile_sensors)
    )
    if args.picture_size is not None:
        env_kwargs["sensor_configs"] = dict(width=args.picture_size, height=args.picture_size)
    header = make_header(env_id, env_kwargs) | dict(recorded_with=source["versions"])
    infos, _ = already_there(args.out, header)
    episodes = source["episodes"][: args.num]
    left = [episode for episode in episodes if episode["episode_seed"] not in infos]
    if not left:
        log.info("%s already holds %d episodes", args.out, len(infos))
        return args.out
    with (
        episode_counter(f"observing {env_id}", len(episodes), len(infos), on_episode) as count,
        worker_pool(args.workers, env_id, env_kwargs, args.out) as pool,
    ):
        for future in as_completed([pool.submit(_observe, args.path, episode) for episode in left]):
            info = future.result()
            infos[info["episode_seed"]] = info
            write_index(args.out, header, dict(sorted(infos.items())))
            count()
    consolidate(args.out)
    return args.out


def _observe(path: Path, recorded: dict[str, Any]) -> dict[str, Any]:
    """In a worker: play an episode again, and write it."""
    seed = recorded["episode_seed"]
    group = f"traj_{recorded['episode_id']}"
    with open_trajectories(path) as file:
        actions = file[group]["actions"][()]
    episode = run_episode(worker_env(), seed, lambda: actions)
    with open_trajectories(path) as file:
        place = _first_difference(file[group]["env_states"], episode.arrays["env_states"])
    if place is not None:
        raise DemonstrationError(
            f"the episode of seed {seed} in {path} does not come out as it was recorded: {place} differs. The versions it "
            "was recorded with stand in the json beside it; use those, or record it again here"
        )
    write_episode(worker["path"], episode)
    return episode.info | dict(episode_seed=seed)


def _first_difference(recorded: h5py.Group, again: dict[str, Any], name: str = "env_states") -> str | None:
    for key, values in again.items():
        if isinstance(values, dict):
            place = _first_difference(recorded[key], values, f"{name}/{key}")
            if place is not None:
                return place
        elif key not in recorded or not np.array_equal(recorded[key][()], values):
            return f"{name}/{key}"
    return None


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
