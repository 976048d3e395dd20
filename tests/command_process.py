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
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from importlib import import_module
from multiprocessing.connection import Connection
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
    path = [str(folder), str(REPOSITORY)] if on_path else [str(REPOSITORY)]
    with tempfile.TemporaryDirectory() as outputs:
        server, connection = _server()
        connection.send((do, list(map(str, arguments)), folder, path, os.environ | environment, outputs))
        try:
            code = connection.recv()
        except BaseException:  # a test's time is up; the next command needs another server
            server.kill()
            _server.cache_clear()
            raise
        out, err = (Path(outputs, name).read_text() for name in ("stdout", "stderr"))
        return CompletedProcess(arguments, code, out, err)


@cache
def _server() -> tuple[subprocess.Popen, Connection]:
    """The process that has imported the libraries, and a connection to it.

    It is not the forkserver, of which a process has only one.
    """
    ours, theirs = multiprocessing.Pipe()
    program = f"from tests.command_process import serve; serve({theirs.fileno()})"
    server = subprocess.Popen([sys.executable, "-c", program], cwd=REPOSITORY, pass_fds=[theirs.fileno()])
    theirs.close()
    return server, ours


def serve(connection: int) -> None:
    """Run each command that comes in a forked process, until the other end of the connection is closed."""
    for library in LIBRARIES:
        import_module(library)
    requests = Connection(connection)
    with suppress(EOFError):
        while True:
            process = multiprocessing.get_context("fork").Process(target=_run, args=requests.recv())
            process.start()
            process.join()
            requests.send(process.exitcode)


def _run(
    do: Callable[[], Any], arguments: list[str], folder: Path, path: list[str], environment: dict[str, str], outputs: str
) -> None:
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(Path(outputs, name), os.O_WRONLY | os.O_CREAT), number)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    sys.path[:] = [*path, *filter(None, sys.path)]  # an empty name is that of the working folder, which `-P` leaves out
    sys.argv[1:] = arguments
    do()
