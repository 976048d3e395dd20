"""Record demonstrations: `manifeel record ManiFeel-PegInsertion-v1 -n 50 --num-procs 2`.

Seeds are tried in order until `num` episodes have succeeded; any number of workers gives the same episodes. A run that was
killed continues where it stopped when the same command is given again.
"""

import logging
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from manifeel_ms3.arguments import require_positive
from manifeel_ms3.command_line import json_object, run
from manifeel_ms3.errors import InvalidArgumentError, WorkFailedError
from manifeel_ms3.experts import require_demonstrator
from manifeel_ms3.progress import episode_counter
from manifeel_ms3.tasks.registry import FIRST_EVALUATION_SEED, task_spec
from manifeel_ms3.tasks.visuotactile_env import SIDES
from manifeel_ms3.workers import WorkerPool

from .episode import demonstrate
from .formats.maniskill_h5 import DemonstrationError
from .recording import (
    Recorder,
    Recording,
    make_header,
    make_recorder,
    next_step,
    open_recording,
    require_demonstration_seeds,
    trajectory_name,
)

log = logging.getLogger(__name__)


@dataclass
class Args:
    """Arguments of the command."""

    env_id: tyro.conf.Positional[str]
    """Id of the task, such as ManiFeel-PegInsertion-v1, or its short name, such as PegInsertion."""
    num: Annotated[int, tyro.conf.arg(name="num-demos", aliases=["-n", "--num"])] = 50
    """Number of successful episodes to record into the file."""
    workers: Annotated[int, tyro.conf.arg(name="num-procs", aliases=["--workers"])] = 1
    """Number of worker processes."""
    seed: int = 0
    """First seed to try. A file holds episodes from one first seed on. Seeds from 100000 on are for evaluation."""
    out: Path | None = None
    """Path of the trajectory file to write. If not given, it is in data/demos/<task>: trajectory.h5 without observations, and
    trajectory.<obs_mode>.<control_mode>.<sim_backend>.h5 with observations."""
    obs_mode: str = "rgb+tacrgb+tacff"
    """Observations to record, joined by "+"; "none" records states and actions alone."""
    cameras: tuple[str, ...] | None = None
    """Cameras to record; all of the task if not given."""
    tactile_sensors: tuple[str, ...] = SIDES
    """Sides of the tactile sensors to record."""
    sensor: str | None = None
    """Sensor on the fingers: gelsight_r15, gelsight_mini, digit, or one of another package; the task's default if not given."""
    env_kwargs: str = "{}"
    """Further arguments of the task as json, such as '{"fit": "tight", "randomization": {"socket_xy": 0.01}}'."""
    max_tries: int = 10
    """Number of seeds to try before giving up, as a multiple of --num-demos."""

    @property
    def path(self) -> Path:
        """Path of the trajectory file."""
        return self.out or Path("data/demos") / self.env_id / trajectory_name(self.env_id, self.all_env_kwargs)

    @property
    def all_env_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment.

        Raises:
            InvalidArgumentError: `env_kwargs` is not a json object.
        """
        cameras = task_spec(self.env_id).env_class.known_cameras() if self.cameras is None else self.cameras
        sensing: dict[str, Any] = dict(cameras=list(cameras), tactile_sensors=list(self.tactile_sensors))
        if self.sensor is not None:
            sensing["sensor"] = self.sensor
        return dict(obs_mode=self.obs_mode, sim_backend="physx_cpu") | sensing | json_object("--env-kwargs", self.env_kwargs)

    @property
    def seeds(self) -> range:
        """Seeds that may be tried.

        Raises:
            InvalidArgumentError: No episode or no try is asked for, or too few demonstration seeds are left from `seed` on.
        """
        if self.num < 1:
            raise InvalidArgumentError(f"--num-demos {self.num}: at least 1 episode must be asked for")
        asked = f"{self.num} episodes from seed {self.seed} on are asked for; "
        require_demonstration_seeds(self.seed, self.num, asked)
        require_positive(max_tries=self.max_tries)
        return range(self.seed, min(self.seed + self.max_tries * self.num, FIRST_EVALUATION_SEED))


def main(args: Args, on_episode: Callable[[], None] | None = None) -> Path:
    """Record, and return the path of the trajectory file.

    Args:
        args: Arguments of the command.
        on_episode: Function that is called after each successful episode; a progress bar is shown if it is not given.

    Raises:
        UnknownNameError: The task is not registered, or has no demonstrator.
        InvalidArgumentError: Seeds that are reserved for evaluation are requested, or an argument is not allowed.
        DemonstrationError: The file was recorded with other arguments, or from other seeds.
        InUseError: Another process records into the file.
        WorkFailedError: Too many seeds failed, or a worker process died.
    """
    args = replace(args, env_id=task_spec(args.env_id).env_id)
    require_demonstrator(args.env_id)
    path, seeds, env_kwargs = args.path, args.seeds, args.all_env_kwargs
    header = make_header(args.env_id, env_kwargs) | dict(failed_seeds=[])
    with open_recording(path, header, seeds) as recording:
        _require_same_seeds(args, recording)
        if recording.is_complete and len(recording.infos) >= args.num:
            log.info("%s already holds %d episodes", path, len(recording.infos))
            return path
        recording.begin()
        with (
            episode_counter(f"recording {args.env_id}", args.num, len(recording.infos), on_episode) as count,
            WorkerPool(args.workers, partial(make_recorder, args.env_id, env_kwargs, recording.drafts)) as pool,
        ):
            left = (seed for seed in seeds if seed not in recording.infos and seed not in recording.failed)
            _submit(pool, left, args, recording, count)
            for finished in pool.as_finished():
                seed, info = finished.task, finished.result()
                count(recording.reject(seed) if info is None else recording.accept(seed, info))
                _submit(pool, left, args, recording, count)
        recording.finish()
    return path


def _require_same_seeds(args: Args, recording: Recording) -> None:
    """Check that a file holds no episodes of seeds that this run would not try.

    Raises:
        DemonstrationError: It does.
    """
    held = [*recording.infos, *recording.kept]
    tried = range(args.seed, args.seed + args.max_tries * max(args.num, len(held)))
    if others := sorted(set(held).difference(tried)):
        raise DemonstrationError(
            f"{recording.path} holds episodes of the seeds {others[0]} to {others[-1]}, this run tries those from {args.seed} "
            "on; give another --out, or the --seed of the file"
        )


def _submit(
    pool: WorkerPool[Recorder, int], seeds: Iterator[int], args: Args, recording: Recording, count: Callable[[int], None]
) -> None:
    """Submit seeds, each one only when the seeds before it cannot suffice, so that the episodes do not depend on timing."""
    while recording.num_finished + pool.num_running < args.num:
        seed = next(seeds, None)
        if seed is None and pool.num_running > 0:
            return  # running episodes may still succeed
        if seed is None:
            all_seeds = args.seeds[-1] == FIRST_EVALUATION_SEED - 1
            more = f"give a --seed below {args.seed}" if all_seeds else f"raise --max-tries {args.max_tries}"
            raise WorkFailedError(
                f"{len(args.seeds)} seeds were tried and {len(recording.infos)} of {args.num} episodes succeeded; see whether "
                f"the demonstrator copes with these arguments, or {more}"
            )
        if seed in recording.kept:
            count(recording.accept_kept(seed))
        else:
            pool.submit(_record_seed, seed)


def _record_seed(recorder: Recorder, seed: int) -> dict[str, Any] | None:
    """In a worker process: record an episode, and return its entry in the json, or None if it failed."""
    episode = demonstrate(recorder.env, recorder.env_id, seed)
    return recorder.write(episode) if episode.info["success"] else None


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
