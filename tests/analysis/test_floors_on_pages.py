"""Failure floors on the page of results: those of the present revisions, beside the rates of the paper's tables."""

from manifeel_ms3.analysis.paper import VISION
from manifeel_ms3.evaluation.floors import floors_of, highest_floor
from manifeel_ms3.tasks.registry import all_tasks, task_spec
from tests.tasks_and_marks import PEG

from .made_up import text_of, write_run


def test_a_row_of_the_papers_tables_has_the_floor_of_its_task(tmp_path):
    write_run(tmp_path, VISION, 0.2)
    table = text_of(tmp_path).split("### Table I, ")[1].split("\n## ")[0]
    assert "| vision + TacFF | floor |" in table
    (row,) = (line for line in table.splitlines() if line.startswith("| PegInsertion | "))
    assert row.endswith(f" | {highest_floor(PEG, task_spec(PEG).revision)} |")


def test_the_page_lists_all_floors_of_present_revisions(tmp_path):
    write_run(tmp_path, VISION, 0.2)
    table = text_of(tmp_path).split("## Failure floors")[1].split("\n## ")[0]
    rows = [line.split(" | ")[:2] for line in table.splitlines() if line.startswith("| ") and "---" not in line]
    measured = [spec for spec in all_tasks().values() if floors_of(spec.env_id, spec.revision)]
    assert rows == [["| task", "revision"], *([f"| {spec.name}", str(spec.revision)] for spec in measured)]
    random = floors_of(PEG, task_spec(PEG).revision)["random"]
    assert f"| PegInsertion | {task_spec(PEG).revision} | {random} of {random.episodes} |" in table
