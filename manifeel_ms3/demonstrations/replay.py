"""Prove that episodes succeed again from their actions: `python -m manifeel_ms3.demonstrations.replay trajectory.h5`."""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from mani_skill.utils import common

from manifeel_ms3.command_line import run
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.tasks.registry import make_env

from .formats.maniskill_h5 import open_trajectories, read_header

log = logging.getLogger(__name__)


@dataclass
class Args:
    path: tyro.conf.Positional[Path]
    """trajectory file"""
    num: int | None = None
    """episodes to replay; default: all"""


@dataclass
class Replay:
    """Outcome of one episode: `deviation` is the largest difference of any object's pose from the recorded one, m or 1."""

    seed: int
    success: bool
    deviation: float


def replay(path: Path, num: int | None = None) -> list[Replay]:
    """Replay episodes from their seeds and actions, without pictures."""
    header = read_header(path)
    kwargs = header["env_info"]["env_kwargs"] | dict(obs_mode="none", render_backend="none")
    env = make_env(header["env_info"]["env_id"], **kwargs)
    results = []
    with progress_bar() as bar:
        for info in bar.track(header["episodes"][:num], description="replaying"):
            actions, ends = _recorded(path, info["episode_id"])
            env.reset(seed=info["episode_seed"])
            success = False
            for action in actions:
                *_, outcome = env.step(action)
                success |= bool(outcome["success"])
            actors = common.to_numpy(env.unwrapped.get_state_dict()["actors"])
            deviation = max(float(np.abs(state[0, :7] - ends[name]).max()) for name, state in actors.items())
            results.append(Replay(info["episode_seed"], success, deviation))
    env.close()
    return results


def _recorded(path: Path, episode: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The actions, and where each object ended."""
    with open_trajectories(path) as file:
        group = file[f"traj_{episode}"]
        actors: Any = group["env_states/actors"]
        return group["actions"][()], {name: actors[name][-1, :7] for name in actors}


def main(args: Args) -> int:
    results = replay(args.path, args.num)
    failures = [result.seed for result in results if not result.success]
    worst = max(result.deviation for result in results)
    log.info("%d of %d episodes succeed again; largest deviation %.1e", len(results) - len(failures), len(results), worst)
    if failures:
        log.error("seeds that failed: %s", failures)
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
