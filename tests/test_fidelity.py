"""docs/fidelity.md is up to date, and gives a reason for every difference."""

from docs import make_fidelity
from manifeel_ms3.tasks.registry import all_tasks


def rows() -> list[list[str]]:
    """Cells of the page's tables, without their heads."""
    lines = (line for line in "".join(make_fidelity.page()).splitlines() if line.startswith("| "))
    cells = ([cell.strip() for cell in line[1:-1].split("|")] for line in lines)
    return [row for row in cells if row[4] in ("same", "different")]


def test_the_page_is_up_to_date():
    assert make_fidelity.PAGE.read_text() == "".join(make_fidelity.page()), "run `python -m docs.make_fidelity`"


def test_each_row_is_whole_and_each_difference_has_its_reason():
    for what, _, _, here, verdict, why in rows():
        assert what
        assert here, what
        assert bool(why) == (verdict == "different"), what


def start_row(task: str) -> list[str]:
    """The row on the half ranges of a task's start."""
    (row,) = (row for row in rows() if row[0] == task and "start_xy" in row[3])
    return row


def test_a_range_that_only_one_side_varies_is_a_difference(monkeypatch):
    assert start_row("PegReorientation")[4] == start_row("GearAssembly")[4] == "same"  # the gear's own `base_yaw` is 0
    theirs = {name: value for name, value in make_fidelity.REORIENTATION_RANGES.items() if name != "start_yaw"}
    monkeypatch.setitem(make_fidelity.CODE_RANGES, "PegReorientation", theirs)
    assert start_row("PegReorientation")[4] == "different"
    assert "screw_depth" not in start_row("BulbInstallation")[3]  # it varies nothing where the bulb starts in the hand


def test_each_task_has_its_rows(monkeypatch):
    names = [row[0] for row in rows()]
    assert all(names.count(spec.name) == 4 for spec in make_fidelity.paper_tasks())
    peg = all_tasks()["ManiFeel-PegInsertion-v1"]
    monkeypatch.setattr(peg, "max_episode_steps", make_fidelity.CODE_LIMIT)
    (limit,) = (row for row in rows() if row[0] == "PegInsertion" and row[2] == "500 steps")
    assert limit[3:5] == ["500 steps", "same"]  # the verdict follows the code
