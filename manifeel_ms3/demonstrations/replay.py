"""Replay episodes from their actions, to see if they end as they were recorded: `manifeel replay FILE`."""

import logging
import sys
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import tyro
from mani_skill.utils import common

from manifeel_ms3.arguments import require_positive
from manifeel_ms3.command_line import as_typed, run
from manifeel_ms3.errors import InvalidArgumentError, UnknownNameError
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.tasks.registry import make_env

from .formats.demonstration_format import POSE_SIZE
from .formats.folder_checks import require_revision
from .formats.maniskill_h5 import (
    DemonstrationError,
    actions_of,
    first_episodes,
    group_of,
    open_trajectories,
    read_header,
    task_of,
)

log = logging.getLogger(__name__)
POSITION, ROTATION = slice(0, 3), slice(3, POSE_SIZE)
"""Parts of an actor's state that are its position (m) and its quaternion wxyz."""


@dataclass
class Args:
    """Arguments of the command."""

    path: tyro.conf.Positional[Path]
    """Path of the trajectory file."""
    num: Annotated[int | None, tyro.conf.arg(name="num-demos", aliases=["-n", "--num"])] = None
    """Number of episodes to replay; all of them if not given."""


@dataclass
class Replay:
    """Outcome of one replayed episode."""

    seed: int
    """Seed of the reset."""
    success: bool
    """Whether the episode succeeded at some step."""
    succeeded: bool
    """Whether it had succeeded when it was recorded."""
    deviation: float
    """Largest difference of any object's last pose from the recorded one: positions in m, quaternions without unit."""


def replay(path: Path, num: int | None = None) -> list[Replay]:
    """Replay episodes from their seeds and actions, without rendering.

    Args:
        path: Trajectory file.
        num: Number of episodes; all of them if not given.

    Raises:
        DemonstrationError: The file is missing or broken, or of another revision of the task.
        UnknownNameError: The task of the file is not registered.
    """
    header = read_header(path)
    require_revision(path, task_of(header), header.get("revision"))
    results = []
    with closing(_recorded_env(path, header)) as env, open_trajectories(path) as file, progress_bar() as bar:
        base: Any = env.unwrapped
        for info in bar.track(first_episodes(path, header, num), description="replaying"):
            actions, ends = _recorded(file, info)
            env.reset(seed=info["episode_seed"])
            success = False
            for action in actions:
                *_, outcome = env.step(action)
                success |= bool(outcome["success"])
            actors: Any = common.to_numpy(base.get_state_dict()["actors"])
            if missing := sorted(set(actors) - set(ends)):
                raise DemonstrationError(f"{path} lacks the states of {missing} in traj_{info['episode_id']}; record it again")
            deviation = max(pose_difference(ends[name], state[0]) for name, state in actors.items())
            results.append(Replay(info["episode_seed"], success, bool(info["success"]), deviation))
    return results


def pose_difference(recorded: np.ndarray, replayed: np.ndarray) -> float:
    """Largest difference of an object's poses, in m or in a quaternion's components; q and -q are the same rotation.

    Args:
        recorded: Recorded states (..., 13), which begin with the pose.
        replayed: States (..., 13) of the replay at the same steps.
    """
    before, after = recorded[..., ROTATION], replayed[..., ROTATION]
    sign = np.where((before * after).sum(-1, keepdims=True) < 0, -1, 1)
    differences = (recorded[..., POSITION] - replayed[..., POSITION], before - sign * after)
    return max(float(np.abs(difference).max()) for difference in differences)


def without_images(env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of a recording's environment, changed so that it observes and renders nothing.

    ManiSkill's tools record with a `render_mode`, which needs a renderer.
    """
    kept = {name: value for name, value in env_kwargs.items() if name not in ("render_mode", "human_render_camera_configs")}
    return kept | dict(obs_mode="none", render_backend="none")


def _recorded_env(path: Path, header: dict[str, Any]) -> gym.Env:
    """The environment that a file's header describes, without rendering; only a registered task is made.

    Raises:
        DemonstrationError: The task does not take the arguments.
        UnknownNameError: The task is not registered.
    """
    env_id, kwargs = header["env_info"]["env_id"], header["env_info"]["env_kwargs"]
    try:
        return make_env(env_id, **without_images(kwargs))
    except UnknownNameError:
        raise
    except InvalidArgumentError as error:
        raise DemonstrationError(f"{path}: {error}, or record the file again") from error


def _recorded(file: Any, episode: dict[str, Any]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The actions (T, A) of a recorded episode, and the last state (13,) of each object."""
    actors = group_of(file, episode)["env_states/actors"]
    return actions_of(file, episode), {name: actors[name][-1] for name in actors}


def main(args: Args) -> int:
    """Replay, and return 1 if an episode neither succeeds nor ends as it was recorded, else 0.

    Raises:
        InvalidArgumentError: The number of episodes is less than 1.
        DemonstrationError: The file is missing or broken.
        UnknownNameError: The task of the file is not registered.
    """
    require_positive(num_demos=args.num)
    results = replay(args.path, args.num)
    failures = [result.seed for result in results if not result.success and result.deviation > 0]
    worst = max((result.deviation for result in results), default=0.0)
    now, then = sum(result.success for result in results), sum(result.succeeded for result in results)
    log.info("%d of %d episodes succeed, and %d did when recorded; %s", now, len(results), then, _comparison(worst))
    if failures:
        log.error("seeds that failed: %s", failures)
    return int(bool(failures))


def _comparison(deviation: float) -> str:
    """How the last poses of all objects compare with the recorded ones, given the largest difference."""
    if deviation == 0:
        return "all objects end bit for bit where they were recorded"
    return (
        f"objects end up to {deviation:.1e} (m, or a component of a quaternion) beside where they were recorded, since another "
        "processor or version rounds differently"
    )


def next_step(args: Args, failed: int) -> str:
    """What the command found, and what one can do next."""
    if failed:
        check = as_typed("manifeel", "validate", args.path)
        return f"{args.path} does not repeat on this machine; {check} checks whether the file is sound"
    film = as_typed("manifeel", "film", args.path, "--out", "FILE.mp4")
    return f"{args.path} repeats on this machine; {film} shows an episode"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
