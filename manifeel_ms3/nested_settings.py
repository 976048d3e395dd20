"""Settings in nested mappings: their innermost entries, and those in which two differ."""

from collections.abc import Iterator, Mapping
from typing import Any


def innermost(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Names and values of the entries that are no mappings, or empty ones.

    Args:
        settings: Values by name, which may be such mappings themselves; their names are joined by dots.
    """
    places = [("", settings)]
    while places:
        place, entries = places.pop()
        for name, value in entries.items():
            if isinstance(value, Mapping) and value:
                places.append((f"{place}{name}.", value))
            else:
                yield f"{place}{name}", value


def differing(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """The values of the innermost entries in which two mappings differ, in the order of their names.

    Args:
        first: Values by name, as `innermost` takes them.
        second: The other values.

    Returns:
        The value in the first and in the second mapping by name; None where one of them has no such entry.
    """
    ours, theirs = dict(innermost(first)), dict(innermost(second))
    return {n: (ours.get(n), theirs.get(n)) for n in sorted(ours.keys() | theirs.keys()) if ours.get(n) != theirs.get(n)}
