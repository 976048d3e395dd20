"""Modules that a user names on a command line, such as that of a task in the working folder: `my_task:MyLab-Press-v1`.

Only what a user types is imported, never a name that comes from a file.
"""

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from .errors import UnknownNameError

FIELDS = ("env_id", "task", "tasks")
"""Arguments of commands that hold ids of tasks."""
_imported: list[str] = []
"""Names of the modules that were imported. Worker processes import them again."""


def import_typed_tasks(args: Any) -> None:
    """Import the modules before the colons of the tasks' ids that the arguments of a command name.

    Args:
        args: Arguments as they were typed. Those that a program makes, from a file for example, must not be given.

    Raises:
        UnknownNameError: There is no such module, neither installed nor in the working folder.
    """
    for field in FIELDS:
        given = getattr(args, field, None) or ()
        for env_id in (given,) if isinstance(given, str) else given:
            module, colon, _ = env_id.rpartition(":")
            if colon:
                _import_typed(module, env_id)


def _import_typed(module: str, env_id: str) -> None:
    look_in_working_folder()
    try:
        import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module exists, and imports another one that does not
        raise UnknownNameError(
            f"the module {module!r} of the task {env_id!r} is neither installed nor in the working folder {Path.cwd()}"
        ) from error
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
