"""What Rerun is given holds every step of what the file holds."""

import re
import subprocess
import sys

import h5py
import pytest

from manifeel_ms3.demonstrations import DemonstrationError, view
from manifeel_ms3.paths import data_dir
from tests.conftest import PEG

FILE = data_dir() / f"sample/{PEG}/trajectory.h5"


def test_everything_is_there(tmp_path):
    pytest.importorskip("rerun")
    out = tmp_path / "peg.rrd"
    view.main(view.Args(FILE, episode=1, save=out))
    command = [sys.executable, "-m", "rerun", "rrd", "print", str(out)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows: dict[str, int] = {}
    for count, place in re.findall(r"with (\d+) rows .* - /(\S+)", printed):
        rows[place] = rows.get(place, 0) + int(count)
    with h5py.File(FILE) as file:
        steps = len(file["traj_1/actions"])
    pictures = ("pictures/wrist", "pictures/tactile_right_forces")
    assert {place: rows[place] for place in pictures} == dict.fromkeys(pictures, steps + 1)
    for place in ("contact_force", "actions", "success"):
        assert rows[place] == steps + 1  # and its lines' names


def test_an_episode_that_is_not_there(tmp_path):
    pytest.importorskip("rerun")
    with pytest.raises(DemonstrationError, match="episodes 0 to 1; there is no 7"):
        view.main(view.Args(FILE, episode=7, save=tmp_path / "x.rrd"))


def test_without_rerun_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ModuleNotFoundError, match=r"manifeel-ms3\[view\]"):
        view.main(view.Args(FILE))
