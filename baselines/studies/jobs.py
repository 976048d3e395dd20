"""What a stage does, in a process of its own. All of it goes on where it was stopped."""

import json
import os
import signal
import socket
import time
import traceback
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil

from baselines.registry import policy_spec, preset_cli
from manifeel_ms3.demonstrations import record
from manifeel_ms3.demonstrations.formats.maniskill_h5 import read_header
from manifeel_ms3.evaluation import evaluate
from manifeel_ms3.evaluation.provenance import machine
from manifeel_ms3.files import write_json

from .study import Stage

DONE, STARTED, FAILED = "done.json", "started.json", "failed.json"


def is_done(stage: Stage, root: Path) -> bool:
    return (stage.folder(root) / DONE).is_file()


def is_running(stage: Stage, root: Path) -> bool:
    """Whether a worker has begun and not ended; one of this machine must be alive."""
    folder = stage.folder(root)
    started = read_note(folder / STARTED)
    if not started or is_done(stage, root) or (folder / FAILED).is_file():
        return False
    return started["host"] != socket.gethostname() or psutil.pid_exists(started["pid"])


def perform(stage: Stage, root: Path, workers: int = 1, *_needed: None) -> None:
    """Do a stage's work, unless it is done, and note what it cost.

    Args:
        workers: processes that simulate.
        _needed: what other stages returned: Ray waits for them.

    Raises:
        Exception: whatever went wrong; failed.json has it, too.
    """
    listen_to_children()
    if is_done(stage, root):
        return
    folder = stage.folder(root)
    folder.mkdir(parents=True, exist_ok=True)
    before = read_note(folder / STARTED)
    attempts = before.get("attempts", 0) + 1
    started = dict(pid=os.getpid(), host=socket.gethostname(), attempts=attempts, title=stage.title, settings=stage.settings)
    write_json(folder / STARTED, started)
    (folder / FAILED).unlink(missing_ok=True)
    begin = time.time()
    try:
        units = WORK[stage.kind](stage, root, workers)
    except Exception as error:
        write_json(folder / FAILED, dict(error=f"{type(error).__name__}: {error}", traceback=traceback.format_exc()))
        raise
    parallel = 1 if stage.kind == "train" else workers
    cost = dict(seconds=round(time.time() - begin, 1), units=units, parallel=parallel, machine=machine())
    write_json(folder / DONE, started | cost)


def listen_to_children() -> None:
    """Ray lets the system reap a process's children unheard: their exit codes, which say whether one died, would be lost."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)


def _record(stage: Stage, root: Path, workers: int) -> int:
    """Demonstrations with everything that any policy sees; returns how many."""
    settings = stage.settings
    path = stage.folder(root) / "trajectory.h5"
    sensing = dict(obs_mode="rgb+tacrgb+tacff", cameras=(settings["camera"],), tactile_sensors=("right",))
    record.main(
        record.Args(settings["env_id"], settings["num"], workers, env_kwargs=settings["env_kwargs"], out=path, **sensing),
        on_episode=lambda: None,
    )
    return len(read_header(path)["episodes"])


def _train(stage: Stage, root: Path, _workers: int) -> int:
    """A policy; returns its gradient steps."""
    settings, (demos,) = stage.settings, stage.needs
    folder = stage.folder(root)
    args = replace(
        training_args(stage),
        demos=(demos.folder(root) / "trajectory.h5",),
        run_dir=folder,
        resume=(folder / "checkpoints/last").exists(),
    )
    last = policy_spec(settings["policy"]).train(args)
    return json.loads((last / "config.json").read_text())["step"]


def _evaluate(stage: Stage, root: Path, workers: int) -> int:
    """A result file a checkpoint; returns how many episodes."""
    settings, (train,) = stage.settings, stage.needs
    checkpoints = sorted(path for path in (train.folder(root) / "checkpoints").iterdir() if path.name.isdigit())
    chosen = checkpoints[-settings["checkpoints"] :]
    wanted = {name: settings[name] for name in ("episodes", "env_kwargs")}
    for checkpoint in chosen:
        out = stage.folder(root) / f"{checkpoint.name}.json"
        if not out.is_file():
            evaluate.main(evaluate.Args(checkpoint, out=out, workers=workers, **wanted))
    return len(chosen) * settings["episodes"]


WORK = dict(record=_record, train=_train, evaluate=_evaluate)


def training_args(stage: Stage) -> Any:
    """What train.py is given, but for where its data and its run are."""
    settings = stage.settings
    flags = [settings["preset"], "--demos", "-"]
    for name, value in settings["flags"].items():
        flags += [f"--{name}", *map(str, value if isinstance(value, list) else [value])]
    return preset_cli(policy_spec(settings["policy"]), flags)


def read_note(path: Path) -> dict[str, Any]:
    """A note that was left; {} if there is none."""
    return json.loads(path.read_text()) if path.is_file() else {}
