"""Modules that a user names to a command, such as that of a task in the working folder.

They stand before the id of a task, as in `my_task:MyLab-Press-v1`, or in an environment variable, for commands that take the
task from a file. Only what a user types is imported, never a name that comes from a file.
"""

import os
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from .errors import UnknownNameError

FIELDS = ("env_id", "task", "tasks")
"""Arguments of commands that hold ids of tasks."""
MODULES = "MANIFEEL_TASKS"
"""Environment variable that names modules of tasks, separated by commas, which every command imports."""
_imported: list[str] = []
"""Names of the modules that were imported, but not this package's. Worker processes import them again."""


def import_typed_tasks(args: Any) -> None:
    """Import the modules that the environment variable names, and those before the colons of tasks' ids among the arguments.

    Args:
        args: Arguments as they were typed. Those that a program makes, from a file for example, must not be given.

    Raises:
        UnknownNameError: There is no such module, neither installed nor in the working folder.
    """
    for module in filter(None, os.environ.get(MODULES, "").split(",")):
        _import_typed(module.strip(), f"the variable {MODULES}")
    for field in FIELDS:
        given = getattr(args, field, None) or ()
        for env_id in (given,) if isinstance(given, str) else given:
            module, colon, _ = env_id.rpartition(":")
            if colon:
                _import_typed(module, f"the task {env_id!r}")


def _import_typed(module: str, named_by: str) -> None:
    look_in_working_folder()
    try:
        import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module exists, and imports another one that does not
        raise UnknownNameError(
            f"the module {module!r} of {named_by} is neither installed nor in the working folder {Path.cwd()}"
        ) from error
    if module not in (__package__, *_imported):
        _imported.append(module)


def imported() -> tuple[str, ...]:
    """Names of the modules that were imported here, for processes that this one starts."""
    return tuple(_imported)


def look_in_working_folder() -> None:
    """Let modules of the working folder be imported, which an installed command, unlike `python -m`, does not find.

    The folder is searched last, so that nothing in it can take the place of an installed module.
    """
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.append(here)
