"""Checks of what a caller gave: the error names the argument, what was given, and what would do."""

import math
from collections.abc import Iterable, Mapping
from numbers import Real
from typing import Any, TypeVar

from .errors import InvalidArgumentError

T = TypeVar("T")


def one_of(name: str, given: T, allowed: Iterable[T]) -> T:
    if given not in list(allowed):
        raise InvalidArgumentError(f"{name}={given!r} is unknown; choose from {list(allowed)}")
    return given


def several_of(name: str, given: Any, allowed: Iterable[str]) -> tuple[str, ...]:
    """A single name counts as one of several."""
    values = (given,) if isinstance(given, str) or not isinstance(given, Iterable) else tuple(given)
    return tuple(one_of(name, value, allowed) for value in values)


def by_name(name: str, given: Any, example: str) -> Mapping[str, Any]:
    if not isinstance(given, Mapping) or not all(isinstance(key, str) for key in given):
        raise InvalidArgumentError(f"{name}={given!r} must be a dict of values by name, like {example}")
    return given


def is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
