"""Each task has a page that is what its script makes, and a film that ManiSkill's tools can find."""

import dataclasses
from pathlib import Path

import pytest

from docs import make_task_cards
from manifeel_ms3.tasks.insertion.base import InsertionRandomization

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
def test_each_task_has_its_film(spec):
    assert spec.env_class._sample_video_link == f"docs/films/{spec.name}.mp4"
    assert (REPOSITORY / spec.env_class._sample_video_link).is_file()


def test_a_page_follows_the_code():
    spec = dataclasses.replace(SPECS[0], max_episode_steps=123, revision=77)
    card = make_task_cards.card(spec)
    assert "123 steps, 12.3 s" in card
    assert "revision 77" in card
    assert "| `fit` | `'paper'` | `'paper'`, `'tight'` |" in card
    assert "Successes | Mean steps" in card
    assert "peg touches or not" in card


def test_each_field_has_its_documentation():
    documented = make_task_cards.field_documentation(InsertionRandomization)
    assert set(documented) == {field.name for field in dataclasses.fields(InsertionRandomization)}
    assert documented["socket_xy"] == "Position of the socket on each axis, in m."


def test_the_rows_of_a_table_are_found_by_the_name_of_the_task(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("| a | b |\n|---|---|\n| One, Two | 1 |\n| Three | 3 |\n")
    assert make_task_cards.rows_of(page, "Two", 2) == (["a", "b"], [["One, Two", "1"]])
    assert make_task_cards.rows_of(page, "Thre", 2) is None
