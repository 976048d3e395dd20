"""How a job runs, in a process of its own, and the files in its folder that hold its status.

A job that was stopped goes on where it stopped when it is run again.
"""

import json
import os
import signal
import socket
import time
import traceback
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import tyro

from baselines.common.checkpoint import saved_checkpoints
from baselines.registry import policy_spec
from baselines.tactile_representations import pretrain
from manifeel_ms3.demonstrations import record
from manifeel_ms3.demonstrations.formats.maniskill_h5 import read_header
from manifeel_ms3.evaluation import evaluate
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config
from manifeel_ms3.evaluation.result import ResultError, is_of_config, published_config, read_result
from manifeel_ms3.files import FileWriteError, remove_folder, write_json
from manifeel_ms3.ownership import owned
from manifeel_ms3.paths import CHECKPOINTS
from manifeel_ms3.processes import process_exists
from manifeel_ms3.provenance import machine

from . import half_precision
from .command_lines import (
    evaluate_arguments,
    half_precision_arguments,
    pretrain_arguments,
    record_arguments,
    training_args,
    trajectory_of,
)
from .planning import Job
from .study import SIMULATING, Resources
from .work import work_of

Status = Literal["waiting", "running", "failed", "done"]
DONE, STARTED, FAILED = "done.json", "started.json", "failed.json"
"""Names of the files in a job's folder that hold its status."""


def is_done(job: Job, root: Path) -> bool:
    """Whether a job has finished its work."""
    return bool(read_status(job.folder(root) / DONE))


def status_of(job: Job, root: Path) -> Status:
    """What became of a job so far; it waits again if its worker on this machine is not alive."""
    folder = job.folder(root)
    if is_done(job, root):
        return "done"
    if (folder / FAILED).is_file():
        return "failed"
    started = read_status(folder / STARTED)
    host, process = started.get("host"), started.get("pid")
    is_alive = isinstance(process, int) and (host != socket.gethostname() or process_exists(process))
    return "running" if is_alive else "waiting"


def perform_in(working_folder: Path, job: Job, root: Path, needs: Resources, *_needed: None) -> None:
    """Do what `perform` does in a working folder, to which relative paths in the study's file belong.

    Ray waits for `_needed`, the return values of the jobs that this one needs.
    """
    if working_folder.is_dir():  # a machine of a cluster may lack it
        os.chdir(working_folder)
    perform(job, root, needs)


def perform(job: Job, root: Path, needs: Resources) -> None:
    """Run a job unless it is done, and write down what it cost.

    Args:
        job: The job.
        root: Folder of all jobs.
        needs: What the study gives the job.

    Raises:
        InUseError: Another process, perhaps of another study, does the job at present.
        Exception: Any error of the job; it is also written to failed.json.
    """
    restore_child_signals()
    with owned(job.folder(root) / STARTED):  # the folder itself is owned by the training that runs in it
        if not is_done(job, root):
            _perform(job, root, needs)


def _perform(job: Job, root: Path, needs: Resources) -> None:
    folder = job.folder(root)
    before, spent = read_status(folder / STARTED), _seconds_spent(folder)
    started = dict(pid=os.getpid(), host=socket.gethostname(), title=job.title, settings=job.settings)
    started |= dict(attempts=before.get("attempts", 0) + 1, seconds_before=round(spent, 1))
    write_json(folder / STARTED, started)
    (folder / FAILED).unlink(missing_ok=True)
    begin = time.time()
    try:
        units = WORK[job.kind](job, root, needs)
    except Exception as error:
        with suppress(FileWriteError):  # on a full disk, the error of the job is raised
            write_json(folder / FAILED, dict(error=f"{type(error).__name__}: {error}", traceback=traceback.format_exc()))
        raise
    parallel = needs.workers if job.kind in SIMULATING else 1
    cost = dict(seconds=round(spent + time.time() - begin, 1), units=units, parallel=parallel)
    cost |= dict(machine=machine(), work=work_of(job, needs.gpus))
    write_json(folder / DONE, started | cost)


def _seconds_spent(folder: Path) -> float:
    """Time that earlier attempts at a job took, each until it wrote its last file: the work in these files is not done again.

    Args:
        folder: Folder of the job. Its hidden files, which name the process that holds it, are of the present attempt.
    """
    if not (started := folder / STARTED).is_file():
        return 0.0
    begin = last = started.stat().st_mtime
    for path in folder.rglob("*"):
        if not path.name.startswith("."):
            with suppress(OSError):  # a process of the earlier attempt may still be about to end
                last = max(last, path.lstat().st_mtime)
    return read_status(started).get("seconds_before", 0.0) + last - begin


def restore_child_signals() -> None:
    """Let this process wait for its children again.

    Ray ignores SIGCHLD, so that the system discards the exit codes of a process's children. Those codes tell whether a
    simulating process has died.
    """
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)


def _record(job: Job, root: Path, needs: Resources) -> int:
    """Record demonstrations with everything that any policy observes, and return their number."""
    record.main(tyro.cli(record.Args, args=record_arguments(job, root, needs.workers)), on_episode=lambda: None)
    return len(read_header(trajectory_of(job, root))["episodes"])


def _pretrain(job: Job, root: Path, needs: Resources) -> int:
    """Train an encoder of TacRGB, and return 1, because only the cost of the whole training is known."""
    pretrain.main(tyro.cli(pretrain.Args, args=pretrain_arguments(job, root, needs.gpus)))
    return 1


def _train(job: Job, root: Path, needs: Resources) -> int:
    """Train a policy, and return the number of its gradient steps."""
    resume = bool(saved_checkpoints(job.folder(root) / CHECKPOINTS))
    last = policy_spec(job.settings["policy"]).train(replace(training_args(job, root, needs.gpus), resume=resume))
    return checkpoint_config(last)["step"]


def _evaluate(job: Job, root: Path, needs: Resources) -> int:
    """Write one result file for each checkpoint, and return the number of episodes.

    Raises:
        WorkFailedError: Every episode of a checkpoint ended in an error of the policy.
    """
    settings, (train,) = job.settings, job.needs
    chosen = saved_checkpoints(train.folder(root) / CHECKPOINTS)[-settings["checkpoints"] :]
    if settings["half_precision"]:
        chosen = [_rounded(checkpoint, job.folder(root) / CHECKPOINTS / checkpoint.name) for checkpoint in chosen]
    for checkpoint in chosen:
        out = job.folder(root) / f"{checkpoint.name}.json"
        if not (is_result_of(checkpoint, out) and _has_answers(out)):
            args = tyro.cli(evaluate.Args, args=evaluate_arguments(job, needs, str(checkpoint), str(out)))
            # episodes that were finished on another machine or with other versions cannot be kept
            evaluate.main(replace(args, overwrite_other=True))
    return len(chosen) * settings["episodes"]


def _has_answers(path: Path) -> bool:
    """Whether the policy acted to the end of some episode; `manifeel eval` fails where it did not, and is repeated."""
    return not all(episode["error"] for episode in read_result(path)["episodes"])


def _rounded(checkpoint: Path, copy: Path) -> Path:
    """The copy of a checkpoint in half precision, which is made where it is missing, or is that of another training."""
    if copy.is_dir() and checkpoint_config(copy) != published_config(checkpoint_config(checkpoint)):
        remove_folder(copy)
    return half_precision.main(tyro.cli(half_precision.Args, args=half_precision_arguments(str(checkpoint), str(copy))))


def is_result_of(checkpoint: Path, path: Path) -> bool:
    """Whether a file is the result of a checkpoint: it is whole, and holds the checkpoint's configuration.

    Args:
        checkpoint: Folder of the checkpoint.
        path: Path of the file, which need not exist.
    """
    try:
        result = read_result(path)
    except ResultError:
        return False
    return is_of_config(result, checkpoint_config(checkpoint))


WORK = dict(record=_record, pretrain=_pretrain, train=_train, evaluate=_evaluate)
"""Function that does the work of a job, by the kind of the job; it returns the number of units whose cost is estimated."""


def read_status(path: Path) -> dict[str, Any]:
    """The content of a status file; {} if there is none, or if it was cut off."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}
