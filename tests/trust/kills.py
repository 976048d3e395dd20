"""Processes that are killed with SIGKILL at a moment of choice."""

import json
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import psutil

from tests.tasks_and_marks import PEG

FILE_EVENTS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir")
"""Python's audit events before each of which a child can be killed."""
PATIENCE = 300  # s
RECORD = """
import json, os, signal, sys
from pathlib import Path

from manifeel_ms3.command_line import run
from manifeel_ms3.demonstrations import record

moment, arguments = json.loads(sys.argv[1]), json.loads(sys.argv[2])
args = record.Args(out=Path(arguments.pop("out")), cameras=(), tactile_sensors=(), **arguments)


def kill(event, given):
    if moment and event == moment[0] and moment[1] in str(given):
        moment[2] -= 1
        if moment[2] < 0:
            os.kill(os.getpid(), signal.SIGKILL)


sys.addaudithook(kill)
print("begin", flush=True)
sys.exit(run(lambda args: record.main(args, lambda: print("episode", flush=True)), args))
"""
"""Program that records; it kills itself before the n-th event on a path with a given part: [event, part, n] or null."""


def start_recording(path: Path, num: int, moment: list | None = None, fit: str = "paper", **kwargs) -> subprocess.Popen:
    """Start a process that records states and actions of the peg, and prints a line for each episode."""
    env_kwargs = json.dumps(dict(fit=fit, render_backend="none"))
    arguments = dict(env_id=PEG, num=num, out=str(path), obs_mode="none", env_kwargs=env_kwargs) | kwargs
    command = [sys.executable, "-c", RECORD, json.dumps(moment), json.dumps(arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def worker_processes(main: int) -> list[psutil.Process]:
    """The worker processes of a main process, of which the number is given: those that its server has forked."""
    return [process for process in psutil.Process(main).children(recursive=True) if process.ppid() != main]


def recorded(path: Path, num: int, moment: list | None = None, **kwargs) -> tuple[int, int, str]:
    """Record to the end, or to the kill; the exit code, the number of episodes reported, and what was said on stderr."""
    process = start_recording(path, num, moment, **kwargs)
    out, errors = process.communicate(timeout=PATIENCE)
    return process.returncode, out.count("episode"), errors


def forked(
    work: Callable[[Callable[[str], None]], None], kill_before: int | None = None, kill_after: float | None = None
) -> tuple[int, int, list[str]]:
    """Do something in a forked child, which is killed before a file event, or after a time.

    Args:
        work: What to do; it is called with a function that reports a word.
        kill_before: Number of the event; the child lives if it is None or beyond the last event.
        kill_after: Time in seconds after which the child is killed, wherever it is; it lives if it has ended by then.

    Returns:
        The exit status as of `os.waitstatus_to_exitcode`, the number of events of a child that lived, and the words.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        _work_in_child(work, kill_before, writing)
    os.close(writing)
    if kill_after is not None:
        time.sleep(kill_after)
        os.kill(child, signal.SIGKILL)  # it has not been waited for, so its number is still its own
    with os.fdopen(reading) as file:
        words = file.read().split()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    events = int(words.pop()) if status == 0 else -1
    return status, events, words


def _work_in_child(work: Callable, kill_before: int | None, writing: int) -> None:
    events = 0

    def count(event: str, _: tuple) -> None:
        nonlocal events
        if event in FILE_EVENTS:
            if events == kill_before:
                os.kill(os.getpid(), signal.SIGKILL)
            events += 1

    try:
        sys.addaudithook(count)
        work(lambda word: os.write(writing, f"{word}\n".encode()))
        os.write(writing, f"{events}\n".encode())
        os._exit(0)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(1)
