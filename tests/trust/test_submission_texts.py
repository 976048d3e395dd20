"""The texts of a submission are shown as texts: neither the page nor the README takes them for markup or scripts."""

import html
import re
from html.parser import HTMLParser

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from manifeel_ms3.leaderboard.__main__ import Build, Submit, main
from manifeel_ms3.leaderboard.links import is_safe_link
from manifeel_ms3.leaderboard.submission import SubmissionError, read_submission
from manifeel_ms3.text import markdown_text

from .files_of_strangers import rewrite_json
from .submissions import NASTY


@pytest.mark.parametrize("text", ["a\nb", "a\rb", "a\u2028b", "a\u202eb", "a\x00b", "a\u200bb", " ", ""])
def test_a15_name_and_authors_are_one_line(folder, text):
    for name in ("name", "authors"):
        rewrite_json(folder / "submission.json", lambda about, name=name: about.update({name: text}))
        with pytest.raises(SubmissionError, match=name):
            read_submission(folder)
        rewrite_json(folder / "submission.json", lambda about, name=name: about.update({name: "x"}))


@pytest.mark.parametrize(
    "link",
    [
        "javascript:alert(1)",
        "JaVaScRiPt:alert(1)//https://a.b",
        "data:text/html,x",
        "//example.org",
        "ftp://example.org",
        "file:///etc/passwd",
        "https://user:password@example.org",
        "https://user@example.org",
        "https://",
        "https:///path",
        "https://a.b/) | 100 % |",
        "https://a.b/\n| row |",
        "https://a.b/\n",
        "https://a.b/<script>",
        'https://a.b/"onclick="x',
        "https://a.b:99999999/",
        "https://a.b:x/",
        " https://a.b",
    ],
)
def test_a15_only_plain_web_addresses_are_links(folder, link):
    assert not is_safe_link(link)
    rewrite_json(folder / "submission.json", lambda about: about.update(link=link))
    with pytest.raises(SubmissionError, match="the link must be an address"):
        read_submission(folder)


class Tags(HTMLParser):
    """Tags of a page with their attributes, without the scripts' contents."""

    def __init__(self, text: str):
        super().__init__()
        self.found: list[tuple[str, dict]] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))


def test_a15_texts_of_a_submission_are_no_markup(folder, tmp_path):
    rewrite_json(
        folder / "submission.json",
        lambda about: about.update(name=NASTY, authors=NASTY, link="https://example.org/a_b?c=d&e=*f*#g"),
    )
    for path in folder.glob("results/*/*.json"):
        rewrite_json(
            path,
            lambda result: result.update(
                policy=NASTY + "\n| forged | row |",
                obs_mode="rgb+tacrgb" + NASTY,
                env_kwargs=dict(obs_mode="rgb+tacrgb" + NASTY, cameras=[NASTY], fit=NASTY),
                config=result["config"] | dict(policy=dict(encoder=dict(image=NASTY[:90], tacrgb=NASTY[:90]))),
            ),
        )
    board = tmp_path / "board"
    main(Submit(folder, rerun=0, board=board))
    main(Build(board))
    lines = [line for line in (board / "README.md").read_text().splitlines() if line.startswith("|")]
    assert len(lines) == 3
    unescaped = [re.findall(r"(?<!\\)[|`*_<>~]", re.sub(r"\]\(https://[^)]*\)", "]", line)) for line in lines]
    assert unescaped[2] == unescaped[0] == ["|"] * unescaped[1].count("|")
    assert re.findall(r"(?<!\\)\]\(([^)]*)", lines[2]) == ["https://example.org/a_b?c=d&e=*f*#g"]
    page = (board / "index.html").read_text()
    tags = Tags(re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)).found
    assert not [tag for tag, attrs in tags if tag in ("img", "b") and "style" not in attrs]
    assert not [name for _, attrs in tags for name in attrs if name.startswith("on")]
    assert [attrs["href"] for tag, attrs in tags if tag == "a"] == ["https://example.org/a_b?c=d&e=*f*#g"]
    assert html.escape(NASTY, quote=False).split()[0] in page


@given(st.text(max_size=60))
@settings(max_examples=300, deadline=None, derandomize=True)
def test_a15_a_cell_of_the_table_has_no_markup(text):
    cell = markdown_text(text)
    assert cell.isprintable()
    assert not re.search(r"(?<!\\)[`*_\[\]{}]", cell.replace("\\\\", ""))
    assert not re.search(r"[<>|~$]|&(?!#\d+;)", cell)
