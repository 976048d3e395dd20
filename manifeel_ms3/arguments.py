"""Checks of arguments. The error names the argument, what was given, and what is allowed."""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from numbers import Real
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
import torch

from .errors import InvalidArgumentError

T = TypeVar("T")


def one_of(name: str, given: T, allowed: Iterable[T]) -> T:
    """Return `given` if it is one of the allowed values.

    Raises:
        InvalidArgumentError: It is not.
    """
    if given not in list(allowed):
        raise InvalidArgumentError(f"{name}={given!r} is unknown; choose from {list(allowed)}")
    return given


def require_choices(settings: Any) -> None:
    """Check that the fields of a dataclass whose type is a `Literal` have one of its values, as the command line does.

    Raises:
        InvalidArgumentError: A field has another value.
    """
    for name, kind in get_type_hints(type(settings)).items():
        if get_origin(kind) is Literal:
            one_of(name, getattr(settings, name), get_args(kind))


def meant(given: str, names: Iterable[str]) -> str:
    """The end of an error about an unknown name: a question with the nearest of the names; "" if none is near."""
    near = get_close_matches(given, list(names), n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


def several_of(name: str, given: Any, allowed: Iterable[str]) -> tuple[str, ...]:
    """Return the given names as a tuple if all of them are allowed; a single name counts as a tuple of one.

    Raises:
        InvalidArgumentError: One of them is not allowed.
    """
    values = (given,) if isinstance(given, str) or not isinstance(given, Iterable) else tuple(given)
    return tuple(one_of(name, value, allowed) for value in values)


def names_in(given: Any) -> tuple[str, ...]:
    """The names in an argument, such as `cameras`, that is one name, several names, or None; () for anything else."""
    if isinstance(given, str):
        return (given,)
    return tuple(map(str, given)) if isinstance(given, (list, tuple)) else ()


def by_name(name: str, given: Any, example: str) -> Mapping[str, Any]:
    """Return `given` if it is a mapping with strings as keys.

    Raises:
        InvalidArgumentError: It is not; the message shows the example.
    """
    if not isinstance(given, Mapping) or not all(isinstance(key, str) for key in given):
        raise InvalidArgumentError(f"{name}={given!r} must be a dict of values by name, like {example}")
    return given


def is_number(value: Any) -> bool:
    """Whether a value is a finite real number, and not a bool."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def require_amount(name: str, value: Any) -> None:
    """Check that a value is a finite number of at least 0.

    Args:
        name: What the message begins with, such as "--lr " or "pose_noise=".
        value: The value.

    Raises:
        InvalidArgumentError: It is not.
    """
    if not (is_number(value) and value >= 0):
        raise InvalidArgumentError(f"{name}{value} must be a number of at least 0")


def require_at_least(least: int, **settings: int) -> None:
    """Check numbers among the settings of an object.

    Args:
        least: Smallest number that is allowed.
        **settings: Numbers by the names of their settings.

    Raises:
        InvalidArgumentError: A number is smaller.
    """
    _require(least, {f"{name}=": given for name, given in settings.items()})


def require_positive(**flags: int | None) -> None:
    """Check that whole numbers of a command line are at least 1.

    Args:
        **flags: Numbers by the names of their flags, with underscores; None if a flag was not given.

    Raises:
        InvalidArgumentError: A number is less than 1.
    """
    _require(1, {f"{flag_of(name)} ": given for name, given in flags.items()})


def require_not_negative(**flags: int | None) -> None:
    """Check that whole numbers of a command line are at least 0.

    Args:
        **flags: Numbers by the names of their flags, with underscores; None if a flag was not given.

    Raises:
        InvalidArgumentError: A number is less than 0.
    """
    _require(0, {f"{flag_of(name)} ": given for name, given in flags.items()})


def require_file(flag: str, path: Path, example: str) -> None:
    """Check, before the work begins, that a file can be written to a path.

    Args:
        flag: Flag with the path.
        path: The path; neither the file nor its folder need be there yet.
        example: Name of a file in the folder, for the message.

    Raises:
        InvalidArgumentError: The path is that of a folder, or no file can be made there.
    """
    if path.is_dir():
        raise InvalidArgumentError(f"{flag} {path} is a folder; give the path of a file, such as {path / example}")
    nearest = next(folder for folder in path.absolute().parents if os.access(folder, os.F_OK))
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        reason = "may not be written to" if nearest.is_dir() else "is a file"
        raise InvalidArgumentError(f"{flag} {path} cannot be written, because {nearest} {reason}; give another path")


def flag_of(name: str) -> str:
    """The flag of a command line for a name with underscores."""
    return f"--{name.replace('_', '-')}"


def _require(least: int, numbers: Mapping[str, int | None]) -> None:
    for name, given in numbers.items():
        if given is not None and given < least:
            raise InvalidArgumentError(f"{name}{given} must be at least {least}; give a larger number")


def checked_action(action: Any, shapes: Sequence[tuple[int, ...]], device: torch.device | str = "cpu") -> torch.Tensor:
    """Return an action as a float32 tensor.

    Args:
        action: Array, tensor or nested sequence of numbers.
        shapes: Shapes that the task takes.
        device: Device of the result.

    Raises:
        InvalidArgumentError: The action is not made of numbers, has another shape, or holds NaN or infinity.
    """
    try:
        array = action.detach().clone() if isinstance(action, torch.Tensor) else torch.from_numpy(np.array(action, np.float32))
        tensor = array.to(device, torch.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InvalidArgumentError(f"the action is no array of numbers ({error}): {action!r}") from error
    if tuple(tensor.shape) not in shapes:
        expected = " or ".join(str(shape) for shape in dict.fromkeys(shapes))
        raise InvalidArgumentError(f"the action has shape {tuple(tensor.shape)}, the task takes {expected}")
    if not torch.isfinite(tensor).all():
        raise InvalidArgumentError(f"the action holds NaN or infinity: {tensor.tolist()}; give finite numbers")
    return tensor
