"""A hook of mkdocs: formulas become MathML, and the site gets the leaderboard and the notebook, to which its pages link."""

import re
import shutil
from html import unescape
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

from manifeel_ms3.files import write_text
from manifeel_ms3.leaderboard.page import PAGE, leaderboard_page, rows_on

REPOSITORY = Path(__file__).parents[1]
NOTEBOOK = "examples/quickstart.ipynb"
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The first page lies one folder deeper in the repository than on the site; its link to the notebook fits both."""
    return markdown.replace(f"](../{NOTEBOOK})", f"]({NOTEBOOK})") if page.is_homepage else markdown


def on_page_content(html: str, **_: Any) -> str:
    """Formulas as MathML, which browsers draw without a script; those that are wider than the page can be scrolled."""
    return FORMULA.sub(_mathml, html)


def _mathml(found: re.Match[str]) -> str:
    is_block = found[1] == "div"
    formula = convert(unescape(found[2]), display="block" if is_block else "inline")
    return f'<div class="formula">{formula}</div>' if is_block else formula


def on_post_build(config: Any) -> None:
    """Make the leaderboard's page in the built site, and copy the results that it links, and the notebook, beside it."""
    site, board = Path(config["site_dir"]), REPOSITORY / "leaderboard"
    results = (path for path in board.rglob("*.json") if "checkpoints" not in path.parts)
    for path in (REPOSITORY / NOTEBOOK, *results):
        copy = site / path.relative_to(REPOSITORY)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)
    write_text(site / board.name / PAGE, leaderboard_page(rows_on(board)))
