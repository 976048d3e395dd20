"""Markdown of pages that are made from results."""

import re
from collections.abc import Iterable
from typing import Any

from manifeel_ms3.text import markdown_text

PLAIN = re.compile(r"[\w .,:;+\-=%(){}\"']*")
"""Texts without characters that begin a link, HTML or a cell of a table, or end a line."""


def markdown_table(names: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A Markdown table.

    Args:
        names: Names of the columns.
        rows: Cells of each row; None is an empty cell.
    """
    names = list(names)
    lines = [names, ["---"] * len(names), *(["" if cell is None else str(cell) for cell in row] for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def shown(text: str) -> str:
    """A text of a result in Markdown: as it is if that is safe, or else with its characters escaped, and cut if it is long."""
    return text if PLAIN.fullmatch(text) else markdown_text(text)
