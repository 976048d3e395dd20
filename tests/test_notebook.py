"""The notebook that people begin with runs from its first cell to its last."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tasks_and_marks import needs_renderer

NOTEBOOK = Path(__file__).parents[1] / "examples/quickstart.ipynb"
SMALLER = {
    r"DEMONSTRATIONS, STEPS, EPISODES = [\d, ]+": "DEMONSTRATIONS, STEPS, EPISODES = 1, 2, 1",
    r"MAX_EPISODE_STEPS = \d+": "MAX_EPISODE_STEPS = 80",
}


def cells(kind: str) -> list[str]:
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == kind]


def test_it_shows_what_it_made_and_nothing_of_the_machine():
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    shown = {kind for cell in notebook["cells"] for out in cell.get("outputs", []) for kind in out.get("data", {})}
    assert {"image/png", "image/webp"} <= shown
    for sign in ("site-packages", str(Path.home()), str(NOTEBOOK.parents[1]), "Warning"):
        assert sign not in json.dumps(notebook), sign


def test_its_pages_are_there_and_its_code_is_python():
    for target in re.findall(r"\]\((\.\./[^)]+)\)", "".join(cells("markdown"))):
        assert (NOTEBOOK.parent / target).is_file(), target
    first, *_ = code = cells("code")
    compile("\n".join(code), str(NOTEBOOK), "exec")
    exec(first, {})  # imports everything


@needs_renderer
def test_its_environment_is_made_and_drawn(monkeypatch):
    """The cells before the demonstrations, which take seconds."""
    monkeypatch.setenv("MPLBACKEND", "Agg")
    code = cells("code")
    (recording,) = [k for k, cell in enumerate(code) if "record.main(" in cell]
    names: dict = {}
    exec("\n".join(code[:recording]), names)
    names["plt"].close("all")
    assert len(names["forces"]) == 15
    assert list(names["shown"]) == ["wrist camera", "TacRGB", "TacFF"]


@pytest.mark.slow
@needs_renderer
def test_it_runs_from_top_to_bottom(tmp_path):
    code = "\n".join(cells("code"))
    for numbers, smaller in SMALLER.items():
        code, count = re.subn(numbers, smaller, code)
        assert count == 1, numbers
    environment = os.environ | dict(MPLBACKEND="Agg")
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    assert (tmp_path / "runs/quickstart/episode.webp").stat().st_size > 10_000
    assert "'success_once'" in done.stdout
