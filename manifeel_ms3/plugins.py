"""Plug-ins that installed packages add through entry points (`importlib.metadata`): tasks, policies, encoders and others.

A package registers a plug-in in its `pyproject.toml`; `docs/extending.md` shows one of each group:

    [project.entry-points."manifeel.policies"]
    my_policy = "my_package.train:SPEC"

Only what an installed package registers is ever imported: never a module that a file or a checkpoint names.
"""

import logging
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from .command_line import missing_extras_named
from .errors import MissingExtraError, PluginError, UnknownNameError

log = logging.getLogger(__name__)
TASKS = "manifeel.tasks"
"""Modules that register tasks when they are imported (`manifeel_ms3.tasks.registry.register_task`)."""
POLICIES = "manifeel.policies"
"""Objects with a method `load(checkpoint, **kwargs)` that returns a `manifeel_ms3.evaluation.Policy`."""
SENSORS = "manifeel.sensors"
"""Functions that take the names of a pad and of its link, and return a `manifeel_ms3.sensors.TactileSensorConfig`."""
ENCODERS = "manifeel.encoders"
"""Functions that make a network over TacRGB images, as `baselines.common.encoders.register_tacrgb_encoder` takes them."""
COMMANDS = "manifeel.commands"
"""`Command` objects."""


@dataclass(frozen=True)
class Command:
    """A command of `manifeel`."""

    module: str
    """Module with the command's `Args`, a type that tyro can parse, and its function `main(args)`."""
    about: str
    """What the command does, in a few words, for the list of all commands."""


@cache
def registered(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group by their names, in alphabetical order.

    Raises:
        PluginError: Two packages register different objects under one name.
    """
    found: dict[str, EntryPoint] = {}
    for point in sorted(entry_points(group=group), key=lambda point: point.name):
        other = found.setdefault(point.name, point)
        if other.value != point.value:
            raise PluginError(
                f"{group}: {point.name!r} is registered twice, by {_described(other)} and by {_described(point)}; "
                "uninstall one of the two packages"
            )
    return found


@cache
def load(group: str, name: str) -> Any:
    """The object that a plug-in registers.

    Raises:
        UnknownNameError: No plug-in of this name is registered.
        MissingExtraError: The plug-in needs an optional dependency that is not installed.
        PluginError: The plug-in does not import.
    """
    points = registered(group)
    if name not in points:
        raise UnknownNameError(f"{name!r} is not registered in {group}; registered are {list(points)}")
    try:
        with missing_extras_named():
            return points[name].load()
    except MissingExtraError:
        raise
    except Exception as error:  # a plug-in may raise anything
        raise PluginError(
            f"the plug-in {name!r} of {_described(points[name])} cannot be loaded ({type(error).__name__}: {error}); repair "
            f"or uninstall it. Registered in {group} are {list(points)}"
        ) from error


@cache
def load_all(group: str) -> tuple[dict[str, Any], list[str]]:
    """The objects of a group's plug-ins by name, and the names of those that do not import; the log says why."""
    loaded, broken = {}, []
    for name in registered(group):
        try:
            loaded[name] = load(group, name)
        except PluginError as error:
            log.warning("%s", error)
            broken.append(name)
    return loaded, broken


def _described(point: EntryPoint) -> str:
    return f"{point.value} ({point.dist.name})" if point.dist else point.value
