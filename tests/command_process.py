"""Runs Python modules and code in processes of their own, which share the imports of other libraries to start quickly.

A process that begins from nothing imports torch, ManiSkill and warp for several seconds before it does anything. The processes
here are forked from one that has imported these, and none of this package: each imports that anew, with its plug-ins.
Tests of the beginning of a process itself (its folder, `-P`, a missing renderer) use `subprocess`.
"""

import multiprocessing
import os
import runpy
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

REPOSITORY = Path(__file__).parents[1]
LIBRARIES = ["mani_skill.envs", "warp", "cv2", "diffusers", "h5py", "jsonschema", "scipy.spatial", "tyro", "rich.progress"]


def run_module(
    module: str, *arguments: object, folder: Path, on_path: bool = True, **environment: str
) -> CompletedProcess[str]:
    """What `PYTHONPATH=FOLDER:REPOSITORY python -P -m MODULE ARGUMENTS` does in a folder, and what it prints.

    Args:
        module: Name of the module.
        arguments: Arguments of the command line.
        folder: Working folder.
        on_path: Whether modules and entry points in the folder are found.
        environment: Environment variables that are set or changed.
    """
    return _forked(
        partial(runpy.run_module, module, run_name="__main__", alter_sys=True), arguments, folder, on_path, environment
    )


def run_code(code: str, *, folder: Path, **environment: str) -> CompletedProcess[str]:
    """What `PYTHONPATH=FOLDER:REPOSITORY python -P -c CODE` does in a folder, and what it prints."""
    return _forked(partial(exec, code, {"__name__": "__main__"}), (), folder, True, environment)


def _forked(
    do: Callable[[], Any], arguments: tuple[object, ...], folder: Path, on_path: bool, environment: dict[str, str]
) -> CompletedProcess[str]:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(LIBRARIES)
    path = [str(folder), str(REPOSITORY)] if on_path else [str(REPOSITORY)]
    with tempfile.TemporaryDirectory() as outputs:
        given = (do, list(map(str, arguments)), folder, path, os.environ | environment, outputs)
        process = context.Process(target=_run, args=given)
        process.start()
        process.join()
        out, err = (Path(outputs, name).read_text() for name in ("stdout", "stderr"))
        return CompletedProcess(arguments, process.exitcode or 0, out, err)


def _run(
    do: Callable[[], Any], arguments: list[str], folder: Path, path: list[str], environment: dict[str, str], outputs: str
) -> None:
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(Path(outputs, name), os.O_WRONLY | os.O_CREAT), number)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    sys.path[:0] = path
    sys.argv[1:] = arguments
    do()
