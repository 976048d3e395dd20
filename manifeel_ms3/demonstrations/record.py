"""Record demonstrations: `python -m manifeel_ms3.demonstrations.record ManiFeel-PegInsertion-v1 -n 50 --workers 2`.

Seeds are tried in order until `num` episodes have succeeded; any number of workers gives the same episodes. A run that was
killed goes on where it stopped when the same command is given again.
"""

import logging
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import torch
import tyro

from manifeel_ms3.command_line import json_object, run
from manifeel_ms3.errors import WorkFailedError
from manifeel_ms3.experts import require_demonstrator
from manifeel_ms3.progress import episode_counter
from manifeel_ms3.tasks.registry import make_env, task_spec
from manifeel_ms3.tasks.visuotactile_env import CAMERAS, SIDES

from .episode import demonstrate
from .formats.maniskill_h5 import (
    DemonstrationError,
    consolidate,
    episode_folder,
    finished_episodes,
    read_header,
    split,
    write_episode,
    write_index,
)

log = logging.getLogger(__name__)


@dataclass
class Args:
    env_id: tyro.conf.Positional[str]
    """task, such as ManiFeel-PegInsertion-v1"""
    num: Annotated[int, tyro.conf.arg(aliases=["-n"])] = 50
    """successful episodes wanted"""
    workers: int = 1
    """processes"""
    seed: int = 0
    """first seed"""
    out: Path | None = None
    """trajectory file to write; default data/demos/<task>/trajectory.h5"""
    obs_mode: str = "rgb+tacrgb+tacff"
    """what to observe; "none" keeps states and actions alone"""
    cameras: tuple[str, ...] = CAMERAS
    """cameras to record"""
    tactile_sensors: tuple[str, ...] = SIDES
    """pads to record"""
    env_kwargs: str = "{}"
    """further arguments of the task as json, such as '{"fit": "loose", "randomization": {"socket_xy": 0.01}}'"""
    max_tries: int = field(default=10)
    """give up when this many times `num` seeds have been tried"""


def main(args: Args, on_episode: Callable[[], None] | None = None) -> Path:
    """Record, and return the file's path. `on_episode` is called after each episode, instead of a progress bar."""
    require_demonstrator(args.env_id)
    path = args.out or Path("data/demos") / args.env_id / "trajectory.h5"
    env_kwargs = _env_kwargs(args)
    header = make_header(args.env_id, env_kwargs)
    infos, failed = already_there(path, header)
    if len(infos) >= args.num:
        log.info("%s already holds %d episodes", path, len(infos))
        return path
    with (
        episode_counter(f"recording {args.env_id}", args.num, len(infos), on_episode) as count,
        worker_pool(args.workers, args.env_id, env_kwargs, path) as pool,
    ):
        for seed, info in _episodes(pool, args, infos, failed):
            if info is None:
                failed.add(seed)
            else:
                infos[seed] = info
                count()
            write_index(path, header | dict(failed_seeds=sorted(failed)), dict(sorted(infos.items())))
    consolidate(path)
    return path


def _episodes(pool: ProcessPoolExecutor, args: Args, infos: dict, failed: set[int]):
    """Results (seed, info or None) as they come; a seed is tried only when all before it cannot make up `num` successes."""
    pending: dict[Future, int] = {}
    seed = args.seed
    while len(infos) < args.num:
        while len(infos) + len(pending) < args.num:
            if seed not in infos and seed not in failed:
                if seed - args.seed >= args.max_tries * args.num:
                    raise WorkFailedError(
                        f"{len(failed)} of {seed - args.seed} seeds failed, with no more to try: "
                        f"see whether the demonstrator copes with these arguments, or raise --max-tries {args.max_tries}"
                    )
                pending[pool.submit(_record_seed, seed)] = seed
            seed += 1
        for future in wait(pending, return_when=FIRST_COMPLETED).done:
            yield pending.pop(future), future.result()


def _env_kwargs(args: Args) -> dict[str, Any]:
    pictures = dict(cameras=list(args.cameras), tactile_sensors=list(args.tactile_sensors))
    return dict(obs_mode=args.obs_mode, sim_backend="physx_cpu") | pictures | json_object("--env-kwargs", args.env_kwargs)


def make_header(env_id: str, env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """The json of a trajectory file, but for its episodes."""
    packages = {name: version(name) for name in ("manifeel-ms3", "mani-skill", "sapien", "torch")}
    limit = gym.spec(env_id).max_episode_steps
    return dict(
        # "module:id" is gymnasium's way to import what registers an id: ManiSkill's tools then know it, too. What renders is
        # this machine's affair, and not kept
        env_info=dict(env_id=task_spec(env_id).gym_id, env_kwargs=_without_renderer(env_kwargs), max_episode_steps=limit),
        source_type="scripted",
        source_desc="manifeel_ms3 demonstrator that acts within the policy's controller and on what the pads feel",
        versions=packages,
    )


def _without_renderer(env_kwargs: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in env_kwargs.items() if name != "render_backend"}


def already_there(path: Path, header: dict[str, Any]) -> tuple[dict[int, dict], set[int]]:
    """Episodes and failed seeds that an earlier run has left."""
    failed: set[int] = set()
    if path.is_file():
        before = read_header(path)
        if before["env_info"] != header["env_info"]:
            raise DemonstrationError(
                f"{path} was recorded with {before['env_info']}, this run asks for {header['env_info']}; give another --out, "
                "or delete the file"
            )
        failed = set(before.get("failed_seeds", []))
    return finished_episodes(path), failed


# -------------------------------------------------------------------- in the workers

worker: dict[str, Any] = {}
"""In a worker process: the `env_id`, `env_kwargs` and `path` that it was started for."""


@contextmanager
def worker_pool(workers: int, env_id: str, env_kwargs: dict[str, Any], path: Path) -> Iterator[ProcessPoolExecutor]:
    """Processes with one environment each, for episodes that are written beside `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_file() and not episode_folder(path).is_dir():
        split(path)
    context = get_context("spawn")  # a forked renderer does not work
    pool = ProcessPoolExecutor(workers, context, _start_worker, (env_id, env_kwargs, path))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker(env_id: str, env_kwargs: dict[str, Any], path: Path) -> None:
    torch.set_num_threads(1)  # processes share the cores
    import manifeel_ms3  # noqa: F401

    worker.update(env_id=env_id, env_kwargs=env_kwargs, path=path)


@cache
def worker_env() -> gym.Env:
    """In a worker process: its environment, made when first asked for, so that the one who asks hears what is wrong with it."""
    return make_env(worker["env_id"], **worker["env_kwargs"])


def _record_seed(seed: int) -> dict[str, Any] | None:
    """Record one episode; write it if it succeeded, and return its info, else None."""
    episode = demonstrate(worker_env(), worker["env_id"], seed)
    if not episode.info["success"]:
        return None
    write_episode(worker["path"], episode)
    return episode.info | dict(episode_seed=seed)


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
