"""How a command runs from a shell: its log, its errors and its exit code.

A `ManifeelError` is printed as one line, followed by the path of a page about common problems. Any other exception is a fault
of the program and keeps its traceback.
"""

import atexit
import gc
import json
import logging
import os
import platform
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import metadata, requires
from typing import Any

from packaging.requirements import Requirement

from .errors import InvalidArgumentError, ManifeelError, MissingExtraError
from .paths import troubleshooting
from .typed_modules import MODULES, import_typed_tasks, imported

log = logging.getLogger(__name__)
TRACEBACK = "MANIFEEL_TRACEBACK"
"""Environment variable; if it is not empty, commands also show the traceback of a `ManifeelError`."""
INTERRUPTED = 130
"""Exit code of a command that was interrupted with Ctrl-C or SIGTERM: 128 + SIGINT, the convention of shells."""
PACKAGE = "manifeel-ms3"
"""Name of this package's distribution."""
DISTRIBUTIONS = {"PIL": "pillow", "sklearn": "scikit-learn", "yaml": "pyyaml", "rerun": "rerun-sdk"}
"""Names of distributions by the names of their modules, where the two differ."""
NEWER_PYTHON = {"python_version": "3.99", "python_full_version": "3.99.0"}
"""Variables of requirements' markers, for a version of Python that is newer than any that a marker names."""


def run(main: Callable[[Any], Any], args: Any, next_step: Callable[[Any, Any], str] | None = None) -> int:
    """Run `main(args)` and return the exit code.

    The code is 1 if `main` raises a `ManifeelError` or returns a number other than 0, such as the number of faults that it
    found; otherwise it is 0.

    Args:
        main: Function of the command.
        args: Arguments of the command, as they were typed. The module that stands before the id of a task, as in
            "my_task:MyLab-Press-v1", is imported.
        next_step: Function that takes `args` and the return value of `main`, and returns a text that is logged at the end: what
            the command made, and what one can do with it.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    gc.freeze()  # ManiSkill collects garbage at every reset; it need not search the modules
    atexit.register(gc.freeze)  # else the interpreter searches all objects of torch for garbage as it ends, for about 1 s
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: what is finished is kept, and workers are ended
    try:
        import_typed_tasks(args)
        answer = main(args)
        if next_step:
            log.info("%s", next_step(args, answer))
    except KeyboardInterrupt:
        sys.stderr.write("stopped\n")
        return INTERRUPTED
    except ManifeelError as error:
        if os.environ.get(TRACEBACK):
            raise
        sys.stderr.write(f"error: {error}\nmore: {troubleshooting()}, or {TRACEBACK}=1 for the place where it was raised\n")
        return 1
    return int(bool(answer)) if isinstance(answer, int) else 0


@contextmanager
def missing_extras_named() -> Iterator[None]:
    """Context manager that turns the failed import of an optional dependency into an error that names the extra to install.

    Raises:
        MissingExtraError: The code in the context imports a module that is not installed and that an extra would install.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if not (found := _extra_with(error.name or "")):
            raise
        extra, of_this_python = found
        mend = f"pip install '{PACKAGE}[{extra}]'"
        if not of_this_python:
            mend = f"it needs a newer Python than {platform.python_version()}; there, {mend}"
        raise MissingExtraError(f"{error.name} is not installed: {mend}", name=error.name) from error


def _extra_with(module: str) -> tuple[str, bool] | None:
    """The extra of this package that installs a module, and whether it does so in this Python; None if there is none."""
    package = module.partition(".")[0]
    name = DISTRIBUTIONS.get(package, package).replace("_", "-")
    for requirement in map(Requirement, requires(PACKAGE) or []):
        for extra in metadata(PACKAGE).get_all("Provides-Extra") or []:
            marker = requirement.marker
            if requirement.name == name and marker and marker.evaluate({"extra": extra} | NEWER_PYTHON):
                return extra, marker.evaluate({"extra": extra})
    return None


def as_typed(*words: object) -> str:
    """A command as one types it in a shell, in backquotes; paths with spaces are quoted.

    Modules of tasks that the user named to this command are named to that one, too, where no word does it.
    """
    needed = [module for module in imported() if not any(str(word).startswith(f"{module}:") for word in words)]
    modules = f"{MODULES}={','.join(needed)} " if needed else ""
    return f"`{modules}{shlex.join(map(str, words))}`"


def json_object(flag: str, given: str) -> dict[str, Any]:
    """Parse the value of a flag that must be a json object.

    Args:
        flag: Name of the flag, for the error message.
        given: Value of the flag.

    Raises:
        InvalidArgumentError: The value is not a json object.
    """
    try:
        value = json.loads(given)
    except json.JSONDecodeError as error:
        raise InvalidArgumentError(f'{flag} {given!r} is not json ({error}); quote it like \'{{"fit": "tight"}}\'') from None
    if not isinstance(value, dict):
        raise InvalidArgumentError(f'{flag} {given!r} is not a json object like \'{{"fit": "tight"}}\'')
    return value
