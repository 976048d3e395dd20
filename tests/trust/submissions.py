"""Names, texts and contents of made-up submissions, for the tests of what strangers submit."""

from pathlib import Path

FIRST = "results/0/00000100.json"
NASTY = "<img src=x onerror=alert(1)>|`*_[a](javascript:alert(2))~~$x$ &lt; \\| **b**"
"""A text that would be markup if it were not escaped."""


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
