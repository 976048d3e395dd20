"""Markdown of pages that are made from results."""

import re
from collections.abc import Iterable, Iterator
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


def markdown_tables(text: str) -> Iterator[list[list[str]]]:
    """The tables of a Markdown page, each as its rows of cells; the first row holds the names of the columns.

    Args:
        text: Content of the page.
    """
    for block in re.findall(r"(?:^\|.*\|\n){2,}", text, flags=re.MULTILINE):
        head, _, *rows = ([cell.strip() for cell in line[1:-1].split("|")] for line in block.splitlines())
        yield [head, *rows]


def in_words(items: Iterable[str]) -> str:
    """One or more items as they are listed in a sentence, such as "a, b and c"."""
    *others, last = items
    return f"{', '.join(others)} and {last}" if others else last


def shown(text: str) -> str:
    """A text of a result in Markdown: as it is if that is safe, or else with its characters escaped, and cut if it is long."""
    return text if PLAIN.fullmatch(text) else markdown_text(text)
