"""How a command runs from a shell: what it says while it works, and what it says when it cannot.

An error that this package raises, because of what it was given, is a message and where to read more. Any other is a fault and
keeps its traceback.
"""

import json
import logging
import os
import re
import sys
import traceback
from collections.abc import Callable
from importlib.metadata import metadata, requires
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any

from packaging.requirements import Requirement

from .paths import troubleshooting

TRACEBACK = "MANIFEEL_TRACEBACK"
"""environment variable: anything but "" shows where a refusal was raised"""
INTERRUPTED = 130
PACKAGE = "manifeel-ms3"
DISTRIBUTIONS = {"sklearn": "scikit-learn", "yaml": "pyyaml", "rerun": "rerun-sdk"}
"""of modules that are not called as their distribution is"""
_FOLDERS = [Path(spec.origin).parent for name in ("manifeel_ms3", "baselines") if (spec := find_spec(name)) and spec.origin]


def run(main: Callable[[Any], Any], args: Any) -> int:
    """Run `main(args)`; returns the exit code: 1 where it was refused, or where it answers how many things are wrong."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        answer = main(args)
    except KeyboardInterrupt:
        sys.stderr.write("stopped\n")
        return INTERRUPTED
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        reason = _reason(error)
        if reason is None or os.environ.get(TRACEBACK):
            raise
        sys.stderr.write(f"error: {reason}\nmore: {troubleshooting()}, or {TRACEBACK}=1 for the place where it was raised\n")
        return 1
    return min(answer, 1) if isinstance(answer, int) else 0


def point_to_the_page() -> None:
    """After the traceback of an error that this package raised and nobody caught, name the page that says more."""
    before = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        before(kind, error, trace)
        if isinstance(error, Exception) and trace and _raised_here(error):
            sys.stderr.write(f"more: {troubleshooting()}\n")

    sys.excepthook = hook


def _reason(error: Exception) -> str | None:
    """What to say instead of a traceback, where that is enough."""
    if isinstance(error, ModuleNotFoundError) and (extra := _extra_with(error.name or "")):
        return f"{error.name} is not installed: pip install '{PACKAGE}[{extra}]'"
    return str(error) if _raised_here(error) else None


def _extra_with(module: str) -> str | None:
    """The extra of this package that brings a module."""
    name = DISTRIBUTIONS.get(module, module).replace("_", "-")
    for requirement in map(Requirement, requires(PACKAGE) or []):
        for extra in metadata(PACKAGE).get_all("Provides-Extra") or []:
            if requirement.name == name and requirement.marker and requirement.marker.evaluate({"extra": extra}):
                return extra
    return None


def _raised_here(error: Exception) -> bool:
    """Whether this package raised it, in this process or in a worker."""
    in_worker = re.findall(r'File "(.+?)", line', str(error.__cause__)) if error.__cause__ else []
    file = in_worker[-1] if in_worker else traceback.extract_tb(error.__traceback__)[-1].filename
    return any(Path(file).is_relative_to(folder) for folder in _FOLDERS)


def json_object(flag: str, given: str) -> dict[str, Any]:
    """A flag's value that is a json object, as keyword arguments.

    Raises:
        ValueError: it is not one.
    """
    try:
        value = json.loads(given)
    except json.JSONDecodeError as error:
        raise ValueError(f'{flag} {given!r} is not json ({error}); quote it like \'{{"fit": "loose"}}\'') from None
    if not isinstance(value, dict):
        raise ValueError(f'{flag} {given!r} is not a json object like \'{{"fit": "loose"}}\'')
    return value
