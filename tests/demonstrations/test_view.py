"""What Rerun is given holds every step of what the file holds."""

import json
import re
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from manifeel_ms3.demonstrations import DemonstrationError, view
from manifeel_ms3.errors import InvalidArgumentError, UnknownNameError
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


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere Rerun keeps its settings in another place")
def test_rerun_sends_no_statistics(tmp_path):
    pytest.importorskip("rerun")
    asked = [view._viewer(), "analytics", "config"]
    told = subprocess.run(asked, env=view.without_statistics(tmp_path), capture_output=True, text=True, check=True).stdout
    assert '"analytics_enabled": false' in told


def test_a_file_is_saved_in_a_new_folder_and_not_beside_a_page(tmp_path):
    pytest.importorskip("rerun")
    view.main(view.Args(FILE, save=tmp_path / "new/peg.rrd"))
    assert (tmp_path / "new/peg.rrd").stat().st_size > 0
    with pytest.raises(InvalidArgumentError, match="give one of them"):
        view.main(view.Args(FILE, save=tmp_path / "peg.rrd", web=True))


def test_an_episode_that_is_not_there(tmp_path):
    pytest.importorskip("rerun")
    with pytest.raises(DemonstrationError, match="episodes 0 to 1; there is no 7"):
        view.main(view.Args(FILE, episode=7, save=tmp_path / "x.rrd"))


def test_without_rerun_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ModuleNotFoundError, match=r"manifeel-ms3\[view\]"):
        view.main(view.Args(FILE))


def file_of_one_episode(path: Path, arrays: dict, control_mode: str, env_kwargs: dict) -> Path:
    """A trajectory file with three steps of these arrays."""
    with h5py.File(path, "w") as written:
        group = written.create_group("traj_0")
        for name, values in (dict(contact_force=np.zeros(3), success=np.zeros(3, bool)) | arrays).items():
            group[name] = values
    episode = dict(episode_id=0, episode_seed=5, elapsed_steps=3, success=False, control_mode=control_mode)
    header = dict(env_info=dict(env_id=f"manifeel_ms3:{PEG}", env_kwargs=env_kwargs), episodes=[episode])
    path.with_suffix(".json").write_text(json.dumps(header))
    return path


def test_an_episode_in_joint_mode_is_shown(tmp_path):
    file = file_of_one_episode(tmp_path / "joints.h5", dict(actions=np.zeros((3, 8))), "pd_joint_pos", {})
    streams = view.read_streams(file, 0)
    names, values = streams.series["actions"]
    assert names[:1] + names[6:] == ["panda_joint1", "panda_joint7", "gripper"]
    assert values.shape == (3, len(names))
    assert streams.title == f"{PEG}, seed 5"


def file_with_touch(path: Path, field: np.ndarray, **env_kwargs) -> Path:
    """A trajectory file whose right pad reads this force field (10, 14, 3) all the time."""
    arrays = {"actions": np.zeros((3, 6)), "obs/sensor_data/tactile_right/force_field": np.stack([field] * 4)}
    return file_of_one_episode(path, arrays, "pd_ee_delta_pose_fixed_gripper", env_kwargs)


@pytest.mark.parametrize(
    ("channel", "name"), [(0, "normal, N"), (1, "shear across the finger, N"), (2, "shear along the finger, N")]
)
def test_forces_on_a_pad_have_the_names_of_the_pads_axes(tmp_path, channel, name):
    """Rows lie side by side across the finger, and columns along it (`TactileSensorConfig`)."""
    field = np.zeros((10, 14, 3), np.float32)
    field[4, 6, channel] = 0.5
    names, values = view.read_streams(file_with_touch(tmp_path / "touch.h5", field), 0).series["tactile_right_force"]
    assert {name: value for name, value in zip(names, values[0], strict=True) if value} == {name: 0.5}


OWN_UNITS = dict(wrist=dict(width=64), tactile_right=dict(units="tacsl"))
OTHER_CAMERA = {"theirs": dict(width=64)}


@pytest.mark.parametrize("env_kwargs", [dict(tactile={"units": "tacsl"}), dict(sensor_configs=OWN_UNITS)])
def test_touch_in_the_papers_units_has_its_own_names_and_is_seen(tmp_path, env_kwargs):
    field = np.zeros((10, 14, 3), np.float32)
    untouched = view.read_streams(file_with_touch(tmp_path / "untouched.h5", field, **env_kwargs), 0)
    field[..., 0] = 2e-3  # m
    pressed = view.read_streams(file_with_touch(tmp_path / "pressed.h5", field, **env_kwargs), 0)
    names, values = pressed.series["tactile_right_force"]
    assert names[0] == "penetration, m"
    assert values[0, 0] == pytest.approx(10 * 14 * 2e-3)
    assert not any(name.endswith(", N") for name in names)
    dark, bright = (streams.images["images/tactile_right_forces"][0].astype(int) for streams in (untouched, pressed))
    assert np.abs(bright - dark).max() > 150  # of 255


@pytest.mark.parametrize("env_kwargs", [{}, dict(tactile=None, sensor_configs=None), dict(sensor_configs=OTHER_CAMERA)])
def test_touch_is_in_newtons_where_nothing_else_was_asked_for(tmp_path, env_kwargs):
    field = np.zeros((10, 14, 3), np.float32)
    names, _ = view.read_streams(file_with_touch(tmp_path / "touch.h5", field, **env_kwargs), 0).series["tactile_right_force"]
    assert names[0] == "normal, N"


def test_the_units_of_a_sensor_that_is_not_installed_are_not_guessed(tmp_path):
    field = np.zeros((10, 14, 3), np.float32)
    with pytest.raises(UnknownNameError, match="'theirs' is not registered"):
        view.read_streams(file_with_touch(tmp_path / "touch.h5", field, sensor="theirs"), 0)


def test_actions_of_a_file_without_a_control_mode_are_numbered(tmp_path):
    file = file_with_touch(tmp_path / "touch.h5", np.zeros((10, 14, 3), np.float32))
    about = file.with_suffix(".json")
    header = json.loads(about.read_text())
    for entry in header["episodes"]:
        entry.pop("control_mode")
    about.write_text(json.dumps(header))
    names, values = view.read_streams(file, 0).series["actions"]
    assert names == [str(i) for i in range(values.shape[1])]


def test_actions_of_another_robot_are_numbered():
    assert view.action_names("pd_joint_delta_pos_of_another_robot", 2) == ["0", "1"]
    assert view.action_names("pd_joint_pos", 2) == ["0", "1"]  # another robot's controller may have the same name
