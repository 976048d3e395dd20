"""Markdown of pages that are made from results."""

from collections.abc import Iterable
from typing import Any


def markdown_table(names: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A Markdown table.

    Args:
        names: Names of the columns.
        rows: Cells of each row; None is an empty cell.
    """
    names = list(names)
    lines = [names, ["---"] * len(names), *(["" if cell is None else str(cell) for cell in row] for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
