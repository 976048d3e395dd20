"""Settings in nested mappings: those of a dataclass, and the entries in which two mappings differ."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any


def as_json(settings: Any) -> dict[str, Any]:
    """The fields of a dataclass and of those inside it, in types that json can hold."""
    return json.loads(json.dumps(asdict(settings), default=str))


def differing(first: Mapping[str, Any], second: Mapping[str, Any], place: str = "") -> Iterator[tuple[str, Any, Any]]:
    """The entries in which two mappings differ, in the order of their names.

    Args:
        first: Values by name, which may be such mappings themselves.
        second: The other values. An entry that only one of the two has is one in which they differ.
        place: Text before the names.

    Yields:
        The name of an entry, and its value in the first and in the second mapping; None where one of them has no such entry.
        Names of entries of mappings that both have are joined by dots.
    """
    for name in sorted(first.keys() | second.keys()):
        one, other = first.get(name), second.get(name)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            yield from differing(one, other, f"{place}{name}.")
        elif one != other or (name in first) != (name in second):
            yield f"{place}{name}", one, other
