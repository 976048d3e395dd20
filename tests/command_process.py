"""Runs Python modules and code in processes of their own, which share the imports of other libraries to start quickly.

A process that begins from nothing imports torch, ManiSkill and warp for several seconds before it does anything. The processes
here are forked from one that has imported these, and none of this package: each imports that anew, with its plug-ins.
Tests of the beginning of a process itself (its folder, `-P`, a missing renderer) use `subprocess`.
"""

import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
LIBRARIES = ["mani_skill.envs", "warp", "cv2", "diffusers", "h5py", "jsonschema", "scipy.spatial", "tyro", "rich.progress"]


def run_module(module: str, *arguments: object, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """What `PYTHONPATH=FOLDER:REPOSITORY python -m MODULE ARGUMENTS` does in a folder, and what it prints.

    Args:
        module: Name of the module.
        arguments: Arguments of the command line.
        folder: Working folder, whose modules and entry points are found.
        environment: Environment variables that are set or changed.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(LIBRARIES)
    with tempfile.TemporaryDirectory() as outputs:
        command = [module, *map(str, arguments)]
        process = context.Process(target=_run, args=(command, folder, os.environ | environment, outputs))
        process.start()
        process.join()
        out, err = (Path(outputs, name).read_text() for name in ("stdout", "stderr"))
        return subprocess.CompletedProcess(command, process.exitcode or 0, out, err)


def _run(command: list[str], folder: Path, environment: dict[str, str], outputs: str) -> None:
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(Path(outputs, name), os.O_WRONLY | os.O_CREAT), number)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    sys.path[:0] = [str(folder), str(REPOSITORY)]
    sys.argv[:] = command
    runpy.run_module(command[0], run_name="__main__", alter_sys=True)
