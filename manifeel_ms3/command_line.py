"""How a command runs from a shell: what it says while it works, and what it says when it cannot.

A `ManifeelError` becomes one line and the place where to read more. Any other exception is a fault of the program and keeps
its traceback.
"""

import json
import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import metadata, requires
from typing import Any

from packaging.requirements import Requirement

from .errors import InvalidArgumentError, ManifeelError, MissingExtraError
from .paths import troubleshooting

TRACEBACK = "MANIFEEL_TRACEBACK"
"""Environment variable: if it is not empty, a command shows the traceback of a `ManifeelError`, too."""
INTERRUPTED = 130
"""Exit code of a command that was stopped with Ctrl-C, as shells have it: 128 + SIGINT."""
PACKAGE = "manifeel-ms3"
DISTRIBUTIONS = {"sklearn": "scikit-learn", "yaml": "pyyaml", "rerun": "rerun-sdk"}
"""Names of distributions by their modules, where the two differ."""


def run(main: Callable[[Any], Any], args: Any) -> int:
    """Run `main(args)` and return the exit code.

    The code is 1 where a `ManifeelError` was raised, or where `main` returns a number of faults that is not 0.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        answer = main(args)
    except KeyboardInterrupt:
        sys.stderr.write("stopped\n")
        return INTERRUPTED
    except ManifeelError as error:
        if os.environ.get(TRACEBACK):
            raise
        sys.stderr.write(f"error: {error}\nmore: {troubleshooting()}, or {TRACEBACK}=1 for the place where it was raised\n")
        return 1
    return min(answer, 1) if isinstance(answer, int) else 0


@contextmanager
def missing_extras_named() -> Iterator[None]:
    """Turn the failed import of an optional dependency into an error that names the extra which brings it.

    Raises:
        MissingExtraError: A module is imported in the context that an extra of this package would bring.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if extra := _extra_with(error.name or ""):
            raise MissingExtraError(
                f"{error.name} is not installed: pip install '{PACKAGE}[{extra}]'", name=error.name
            ) from error
        raise


def _extra_with(module: str) -> str | None:
    """The extra of this package that brings a module."""
    package = module.partition(".")[0]
    name = DISTRIBUTIONS.get(package, package).replace("_", "-")
    for requirement in map(Requirement, requires(PACKAGE) or []):
        for extra in metadata(PACKAGE).get_all("Provides-Extra") or []:
            if requirement.name == name and requirement.marker and requirement.marker.evaluate({"extra": extra}):
                return extra
    return None


def json_object(flag: str, given: str) -> dict[str, Any]:
    """The value of a flag that is a json object, as keyword arguments.

    Raises:
        InvalidArgumentError: The value is not a json object.
    """
    try:
        value = json.loads(given)
    except json.JSONDecodeError as error:
        raise InvalidArgumentError(f'{flag} {given!r} is not json ({error}); quote it like \'{{"fit": "loose"}}\'') from None
    if not isinstance(value, dict):
        raise InvalidArgumentError(f'{flag} {given!r} is not a json object like \'{{"fit": "loose"}}\'')
    return value
