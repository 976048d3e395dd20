"""The log of a training run: log.jsonl, tensorboard events, and Weights & Biases."""

import json
import math
import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter  # pyright: ignore[reportPrivateImportUsage] (torch does not list it)

from manifeel_ms3.errors import ServerError
from manifeel_ms3.files import failures_named, read_json_lines, write_text
from manifeel_ms3.tasks.registry import short_name

from .train_args import TrainArgs

LOG = "log.jsonl"
EVENTS = "events.out.tfevents.*"
"""Files of the log in the folder of a run: json lines, and tensorboard's events."""
WANDB_TIMEOUT = 30
"""Longest wait for Weights & Biases to begin a run, s; set once, not tuned."""
WANDB_FINISH_TIMEOUT = 600
"""Longest wait at the end of a run until everything is sent, s; set once, not tuned. What is left stays in the folder of the
run, and `wandb sync` sends it."""
WANDB_ID = "wandb_id.txt"
"""File, in the folder of a run, of the id of the run in Weights & Biases."""
GLOBAL_STEP = "global_step"
"""Name of the gradient step in Weights & Biases, over which everything is drawn."""
TIME = "time/"
"""Prefix of the names of scalars that say how long training takes; they are shown, and not kept in log.jsonl."""


@dataclass(frozen=True)
class WandbRun:
    """Description of a run in Weights & Biases."""

    project: str
    """Name of the project."""
    entity: str | None
    """Team or user; the user's default if None."""
    name: str
    """Name of the run."""
    group: str
    """Group that the run belongs to."""
    tags: tuple[str, ...]
    """Tags of the run."""
    config: dict[str, Any]
    """Further settings beside those of the run, such as `eval_env_cfg`."""


def wandb_run_of(args: TrainArgs, policy: str) -> WandbRun | None:
    """The run in Weights & Biases, described as ManiSkill's baselines describe theirs; None if it is not asked for.

    Args:
        args: Settings of the run, with its name and its task.
        policy: Registered name of the policy.
    """
    if not args.track:
        return None
    assert args.env_id is not None
    evaluated_on = dict(env_id=args.env_id, env_kwargs=json.loads(args.eval_env_kwargs), num_envs=args.num_eval_envs)
    tags = (policy, short_name(args.env_id), args.obs_mode)
    about = dict(eval_env_cfg=evaluated_on)
    return WandbRun(args.wandb_project_name, args.wandb_entity, str(args.exp_name), policy, tags, about)


class RunLog:
    """The log of a training run.

    The entries of a run that is resumed stay up to the checkpoint from which it goes on; later ones are dropped, because
    training writes them again. Tensorboard's events are written anew from the entries that stay, since some can be lost when a
    process is killed.

    Args:
        folder: Folder of the run.
        config: Settings of the run, for Weights & Biases.
        step: Step of the checkpoint from which the run continues; 0 for a new run, which replaces the log in the folder.
        wandb_run: The run in Weights & Biases; it is not used if None.

    Raises:
        ServerError: Weights & Biases cannot be reached.
        FileWriteError: The log cannot be written.
    """

    def __init__(self, folder: Path, config: dict[str, Any], step: int, wandb_run: WandbRun | None):
        if step == 0:  # also without `wandb_run`: a new run must not go on in that of an earlier one when it is resumed
            with failures_named(folder):  # it may be a file
                (folder / WANDB_ID).unlink(missing_ok=True)
        self._wandb = _start_wandb(wandb_run, config, folder) if wandb_run else None
        self.entries = entries_until(folder / LOG, step)
        """Entries of the earlier log that are kept."""
        self._path = folder / LOG
        write_text(self._path, "".join(map(_line, self.entries)))
        for events in folder.glob(EVENTS):
            events.unlink()
        self._board = SummaryWriter(str(folder))
        for entry in self.entries:
            self._show(entry)
        self._lines = self._path.open("a", encoding="utf-8")

    def write(self, entry: Mapping[str, float], video: Path | None = None) -> None:
        """Write an entry: scalars by ManiSkill's names, and "step", which may be earlier than that of the entry before.

        Args:
            entry: The entry.
            video: Video of the evaluation that the entry is about, for Weights & Biases.

        Raises:
            FileWriteError: The entry cannot be written.
        """
        # without times, the log is the same in every run of a seed
        kept = {name: value for name, value in entry.items() if not name.startswith(TIME)}
        with failures_named(self._path):
            self._lines.write(_line(kept))
            self._lines.flush()
            self._show(entry)
        if self._wandb:
            self._wandb.log(
                {GLOBAL_STEP if name == "step" else name: value for name, value in entry.items()} | _video_entry(video)
            )

    def sync(self) -> None:
        """Let all entries reach the disk; a checkpoint of their step may follow.

        Raises:
            FileWriteError: The entries cannot be written.
        """
        with failures_named(self._path):
            os.fsync(self._lines.fileno())

    def _show(self, entry: Mapping[str, float]) -> None:
        """Write an entry to tensorboard."""
        for name, value in entry.items():
            if name != "step":
                self._board.add_scalar(name, value, int(entry["step"]))

    def __enter__(self) -> "RunLog":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        """Finish the log; Weights & Biases shows a run that an exception has ended as failed."""
        self._lines.close()
        self._board.close()
        if self._wandb:
            self._wandb.finish(exit_code=int(kind is not None))


def entries_until(log: Path, step: int) -> list[dict[str, float]]:
    """The entries of a log up to a step; an incomplete line, left by a killed process, is left out.

    Args:
        log: Path of the log, which need not exist.
        step: Last step whose entries are wanted.
    """
    return [entry for entry in read_json_lines(log) if entry.get("step", math.inf) <= step] if step else []


def _line(entry: Mapping[str, float]) -> str:
    return json.dumps(entry) + "\n"


def _video_entry(video: Path | None) -> dict[str, Any]:
    if video is None:
        return {}
    import wandb

    return {"eval/video": wandb.Video(str(video), format="mp4")}


def _start_wandb(run: WandbRun, config: dict[str, Any], folder: Path) -> Any:
    """Start a run in Weights & Biases, or continue the one whose id is in the folder of the training."""
    import wandb
    from wandb.errors import CommError, UsageError

    id_file = folder / WANDB_ID
    if not id_file.is_file():
        write_text(id_file, secrets.token_hex(8))
    try:
        settings = wandb.Settings(init_timeout=WANDB_TIMEOUT, finish_timeout=WANDB_FINISH_TIMEOUT)
        about: dict[str, Any] = dict(project=run.project, entity=run.entity, name=run.name, group=run.group, tags=run.tags)
        about |= dict(id=id_file.read_text(encoding="utf-8"), resume="allow")
        started = wandb.init(**about, config=config | run.config, dir=str(folder), settings=settings)
        # evaluations finish later than the steps that they are about, which wandb's own count does not allow
        started.define_metric("*", step_metric=GLOBAL_STEP)
        return started
    except (CommError, UsageError) as error:
        raise ServerError(
            f"Weights & Biases does not accept the run ({error}); log in with `wandb login`, write it to disk with "
            "WANDB_MODE=offline, or leave out --track"
        ) from error
