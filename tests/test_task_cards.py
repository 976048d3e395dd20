"""Each task has a page that is up to date, and a video that ManiSkill's tools can find."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from docs import make_task_cards, make_task_videos
from manifeel_ms3.tasks.insertion.base import InsertionRandomization
from tests.links import missing_targets

SPECS = make_task_cards.own_tasks()
REPOSITORY = Path(__file__).parents[1]


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.name)
def test_the_page_is_up_to_date(spec):
    made = make_task_cards.card(spec)
    assert make_task_cards.card_path(spec).read_text() == made, "run `python -m docs.make_task_cards`"


def test_all_pages_are_on_the_site():
    lines = (REPOSITORY / "mkdocs.yml").read_text()
    assert all(f"tasks/{spec.name}.md" in lines for spec in SPECS)
    assert {path.stem for path in make_task_cards.CARDS.glob("*.md")} == {spec.name for spec in SPECS}


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.name)
def test_each_task_has_its_video(spec):
    assert spec.env_class._sample_video_link == f"docs/videos/{spec.name}.mp4"
    assert (REPOSITORY / spec.env_class._sample_video_link).is_file()


def test_the_videos_show_the_samples_of_today():
    shown = json.loads(make_task_videos.SAMPLES.read_text())
    assert set(shown) == {"demonstrations.webp"} | {f"{spec.name}.mp4" for spec in SPECS}
    older = [video for video, hashes in shown.items() if hashes != make_task_videos.hashes_of(tuple(hashes))]
    assert older == [], "run `python -m docs.make_task_videos`"


def test_the_video_of_the_readme_is_small():
    assert (REPOSITORY / "docs/images/demonstrations.webp").stat().st_size < 3e6


def test_a_page_follows_the_code():
    spec = dataclasses.replace(SPECS[0], max_episode_steps=123, revision=77)
    card = make_task_cards.card(spec)
    assert "123 steps, 12.3 s" in card
    assert "revision 77" in card
    assert "| `fit` | `'paper'` | `'paper'`, `'tight'` |" in card
    assert "Successes | Mean steps" in card
    assert "peg touches or not" in card


def card_of(name: str) -> str:
    return make_task_cards.card(next(spec for spec in SPECS if spec.name == name))


def test_a_variant_of_a_task_is_described_as_fully_as_the_task():
    card = card_of("BallSortingDim")
    assert "BallSorting at 5 % of the light.\n\n" in card
    assert all(f"**{what}" in card for what in ("Task Description:**", "Randomizations:**", "Success Conditions:**"))
    lighting = [line for line in card.splitlines() if line.startswith("| `lighting` |")]
    assert lighting == ["| `lighting` | `'dim'` | `'normal'`, `'dim'` |"]


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.name)
def test_a_page_lists_the_results_of_its_task(spec):
    """Each result of the page of results is in the page of its task, with a link that leads to the same file."""
    results = (REPOSITORY / "docs/results.md").read_text()
    rows = re.findall(rf"^\| {spec.name} revision {spec.revision} \|.*", results, flags=re.MULTILINE)
    links = [link for row in rows for link in re.findall(r"\]\((\S+\.json)\)", row)]
    page = make_task_cards.card_path(spec)
    after = page.read_text().partition("\n## Results\n\n")[2]
    linked = [(page.parent / link).resolve() for link in re.findall(r"\]\((\S+\.json)\)", after)]
    assert linked == [(REPOSITORY / "docs" / link).resolve() for link in links]
    assert ("No policy has been evaluated" in after) == (not rows)
    assert not missing_targets(page)


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.name)
def test_an_empty_line_precedes_each_heading(spec):
    assert not re.search(r"[^\n]\n#", make_task_cards.card(spec))


def test_each_field_has_its_documentation():
    documented = make_task_cards.field_documentation(InsertionRandomization)
    assert set(documented) == {field.name for field in dataclasses.fields(InsertionRandomization)}
    assert documented["socket_xy"] == "Position of the socket on each axis, in m."


def test_the_rows_of_a_table_are_found_by_the_name_of_the_task(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("| a | b |\n|---|---|\n| One, Two | 1 |\n| Three | 3 |\n")
    assert make_task_cards.rows_of(page, "Two", 2) == (["a", "b"], [["One, Two", "1"]])
    assert make_task_cards.rows_of(page, "Thre", 2) is None
