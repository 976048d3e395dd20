"""What Rerun is given holds every step of what the file holds."""

import json
import re
import subprocess
import sys

import h5py
import numpy as np
import pytest

from manifeel_ms3.demonstrations import DemonstrationError, view
from tests.sample import observed_sample
from tests.tasks_and_marks import PEG

FILE = observed_sample(PEG)


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
    images = ("images/wrist", "images/tactile_right_forces")
    assert {place: rows[place] for place in images} == dict.fromkeys(images, steps + 1)
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


def test_an_episode_in_joint_mode_is_shown(tmp_path):
    file = tmp_path / "joints.h5"
    with h5py.File(file, "w") as written:
        group = written.create_group("traj_0")
        group["actions"], group["contact_force"], group["success"] = np.zeros((3, 8)), np.zeros(3), np.zeros(3, bool)
    episode = dict(episode_id=0, episode_seed=5, elapsed_steps=3, success=False, control_mode="pd_joint_pos")
    header = dict(env_info=dict(env_id=f"manifeel_ms3:{PEG}", env_kwargs={}), episodes=[episode])
    file.with_suffix(".json").write_text(json.dumps(header))
    streams = view.read_streams(file, 0)
    names, values = streams.series["actions"]
    assert names[:1] + names[6:] == ["panda_joint1", "panda_joint7", "gripper"]
    assert values.shape == (3, len(names))
    assert streams.title == f"{PEG}, seed 5"


def test_actions_of_another_robot_are_numbered():
    assert view.action_names("pd_joint_delta_pos_of_another_robot", 2) == ["0", "1"]
