"""The table of limits in docs/evaluation.md has the limits that the tasks are registered with."""

import re
from pathlib import Path

from docs.make_task_cards import own_tasks

PAGE = Path(__file__).parents[2] / "docs" / "evaluation.md"
HEADING = "| Task | Time limit, steps at 10 Hz | Force limit, N |\n|---|---|---|\n"


def test_the_documented_limits_are_those_of_the_tasks():
    rows = PAGE.read_text().split(HEADING)[1].split("\n\n")[0]
    documented = re.findall(r"^\| (\w+) \| (\d+) \| ([\d.]+) \|$", rows, re.MULTILINE)
    assert len(documented) == len(rows.splitlines())
    registered = {spec.name: (spec.max_episode_steps, spec.force_limit) for spec in own_tasks()}
    assert {name: (int(steps), float(force)) for name, steps, force in documented} == registered
