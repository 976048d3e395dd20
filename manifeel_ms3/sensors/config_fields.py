"""Fields of the sensor's configuration: the range of each number, and changes by dotted name."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Integral
from pathlib import Path
from types import UnionType
from typing import Any, cast

from manifeel_ms3.arguments import by_name, is_number
from manifeel_ms3.errors import InvalidArgumentError, UnknownNameError


@dataclass(frozen=True)
class Bounds:
    """Range of the number, or of each number, that a field holds; `low` belongs to it unless `high` is infinite."""

    low: float = 0.0
    high: float = math.inf
    whole: bool = False
    """Whether the numbers are whole, of a type of whole numbers."""

    def __contains__(self, number: float) -> bool:
        if not is_number(number) or (self.whole and not isinstance(number, Integral)):
            return False
        return self.low < number if math.isinf(self.high) else self.low <= number <= self.high

    def __str__(self) -> str:
        span = "positive" if math.isinf(self.high) else f"in [{self.low:g}, {self.high:g}]"
        return f"{span} and whole" if self.whole else span


def positive(default: Any) -> Any:
    """Dataclass field for positive numbers."""
    return field(default=default, metadata={"bounds": Bounds()})


def counts(default: tuple[int, ...]) -> Any:
    """Dataclass field for positive whole numbers."""
    return field(default=default, metadata={"bounds": Bounds(whole=True)})


def within(default: Any, low: float, high: float) -> Any:
    """Dataclass field for a number, or a tuple of numbers, from `low` to `high`."""
    return field(default=default, metadata={"bounds": Bounds(low, high)})


def amount(high: float) -> Any:
    """Dataclass field for an amount from 0 to `high`: a pair (least, most) for each episode to draw from, or one number."""
    return field(default=(0.0, 0.0), metadata={"bounds": Bounds(0.0, high), "amount": True})


def check_bounds(config: Any, uid: str, prefix: str = "") -> None:
    """Check the fields of a dataclass, and of the dataclasses in it, against their bounds.

    Args:
        config: The dataclass.
        uid: Name of the sensor in messages.
        prefix: Start of the fields' names in messages.

    Raises:
        InvalidArgumentError: A number is out of its bounds, a tuple has another length than it should have, or a pair is not in
            rising order; the message names the field.
    """
    for entry in dataclasses.fields(config):
        name, value = prefix + entry.name, getattr(config, entry.name)
        if dataclasses.is_dataclass(value):
            check_bounds(value, uid, f"{name}.")
        bounds = entry.metadata.get("bounds")
        numbers: Sequence[Any] = value if isinstance(value, Sequence) else (value,)
        if bounds and any(number not in bounds for number in numbers):
            raise InvalidArgumentError(f"{name}={value!r} of tactile sensor {uid!r} must be {bounds}")
        if bounds and isinstance(entry.default, tuple) and len(numbers) != len(entry.default):
            raise InvalidArgumentError(f"{name}={value!r} of tactile sensor {uid!r} must be {len(entry.default)} numbers")
        if entry.metadata.get("amount") and (len(numbers) != 2 or numbers[0] > numbers[1]):
            raise InvalidArgumentError(f"{name}={value!r} of tactile sensor {uid!r} must be a number, or a pair (least, most)")


def with_options(config: Any, options: Mapping[str, Any]) -> Any:
    """Copy of a dataclass with some fields changed, by dotted name: `{"units": "tacsl", "optics.noise": 2.0}`.

    The fields are changed together, so that their order does not matter, and only the result must be sound.

    Raises:
        UnknownNameError: A name is not that of a field; the message lists those that exist.
        InvalidArgumentError: A value is of another type than the field's, or is not allowed.
    """
    given = by_name("tactile", options, '{"units": "tacsl", "optics.noise": 2.0}')
    return _changed(config, {tuple(name.split(".")): value for name, value in given.items()}, ())


def _changed(config: Any, options: Mapping[tuple[str, ...], Any], outer: tuple[str, ...]) -> Any:
    """Copy of a dataclass with the fields changed to which paths lead; `outer` leads to the dataclass, for messages."""
    known = {entry.name: entry for entry in dataclasses.fields(config)} if dataclasses.is_dataclass(config) else {}
    for path in options:
        if path[0] not in known:
            name = ".".join((*outer, *path))
            raise UnknownNameError(f"tactile option {name!r}: {path[0]!r} is not a field; choose from {list(known)}")
    whole = {path[0]: value for path, value in options.items() if len(path) == 1}
    changed = {
        name: _value_of(known[name], getattr(config, name), value, ".".join((*outer, name))) for name, value in whole.items()
    }
    for first in dict.fromkeys(path[0] for path in options if len(path) > 1):
        inner = {path[1:]: value for path, value in options.items() if path[0] == first and len(path) > 1}
        changed[first] = _changed(changed.get(first, getattr(config, first)), inner, (*outer, first))
    return dataclasses.replace(cast(Any, config), **changed)


def _value_of(entry: dataclasses.Field, present: Any, value: Any, name: str) -> Any:
    """The value that a field takes, if it is of the field's type; the option's name is for messages."""
    if isinstance(entry.type, UnionType):  # a part that may be absent
        if not isinstance(value, entry.type):
            raise InvalidArgumentError(f"tactile option {name!r}: expected {entry.type}, not {value!r}")
        return value
    if entry.metadata.get("amount") and is_number(value):
        value = (value, value)
    if not _is_like(value, present):
        raise InvalidArgumentError(f"tactile option {name!r}: expected a value like {present!r}, not {value!r}")
    return tuple(value) if isinstance(present, tuple) else value


def _is_like(value: Any, present: Any) -> bool:
    """Whether `value` has the type, and for a tuple the length, that a field with the value `present` needs."""
    if isinstance(present, tuple):
        return isinstance(value, list | tuple) and len(value) == len(present) and all(map(_is_like, value, present))
    if isinstance(present, float):
        return is_number(value)
    if isinstance(present, str | Path):
        return isinstance(value, str | Path)
    return type(value) is type(present)
