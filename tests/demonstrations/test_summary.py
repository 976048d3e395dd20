"""What the summary of a file says is what the file holds."""

import io
import json
import re
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from mani_skill.utils.wrappers import RecordEpisode
from rich.console import Console

from baselines.common.dataset import read_episodes
from baselines.common.observation import observation_spec
from manifeel_ms3.demonstrations import DemonstrationError, read_header
from manifeel_ms3.demonstrations.formats.maniskill_h5 import open_trajectories
from manifeel_ms3.demonstrations.recording import STATES_FILE, observed_file
from manifeel_ms3.demonstrations.replay import Args, main, replay
from manifeel_ms3.demonstrations.summary import sparkline, summary
from manifeel_ms3.demonstrations.validate import validate
from manifeel_ms3.demonstrations.view import read_streams
from tests.command_process import run_code
from tests.sample import observed_sample, states_sample
from tests.tasks_and_marks import PEG, needs_renderer
from tests.trajectories import arrays_of, renumbered

SAMPLE = observed_sample(PEG)


def test_it_counts_what_is_there():
    page = io.StringIO()
    Console(width=160, file=page).print(summary(SAMPLE))
    told = page.getvalue()
    episodes = read_header(SAMPLE)["episodes"]
    with open_trajectories(SAMPLE) as file:
        forces = [file[f"traj_{i}/contact_force"][()] for i in range(len(episodes))]
    assert f"{PEG}, revision {read_header(SAMPLE)['revision']} " in told
    assert f"manifeel-ms3 {read_header(SAMPLE)['versions']['manifeel-ms3']}, " in told
    assert f"{len(episodes)}, {len(episodes)} successes, 0 seeds that failed" in told
    assert f"{sum(episode['elapsed_steps'] for episode in episodes)} in all" in told
    assert all(f"{force.max():.1f}" in told for force in forces)
    between = sum(((force >= 10) & (force < 20)).sum() for force in forces)
    assert f"│ 10 to 20         │ {between} " in told
    assert "obs/sensor_data/wrist/rgb" in told


def test_texts_of_the_file_are_shown_as_texts(tmp_path):
    """They neither end the command as broken markup nor reach the terminal as links, colours or titles."""
    path = renumbered(states_sample(PEG), tmp_path)
    header = read_header(path)
    nasty = "x [/] [red]y[/red] [link=https://a.b]z \x1b[31m \x1b]0;title\x07 \u202e"
    header |= dict(source_type=nasty, versions={nasty: nasty})
    header["env_info"]["env_kwargs"]["obs_mode"] = nasty
    path.with_suffix(".json").write_text(json.dumps(header))
    page = io.StringIO()
    Console(width=400, file=page, force_terminal=True, color_system="truecolor").print(summary(path))
    told = page.getvalue()
    assert told.count("x [/] [red]y[/red] [link=https://a.b]z [31m ]0;title") == 4
    assert not re.search("\x1b\\[31m|\x1b]|\x07|\u202e", told)


def test_a_sparkline_shows_where_it_is_high():
    line = sparkline(np.r_[np.zeros(70), 5.0, np.zeros(9), np.full(80, 10.0)], top=10.0)
    assert len(line) == 28
    assert line == 11 * " " + "▄" + " " + 15 * "█"
    assert sparkline(np.zeros(0), 1.0) == ""
    assert sparkline(np.zeros(3), 0.0) == "   "


def test_a_file_that_is_not_there_is_said(tmp_path):
    with pytest.raises(DemonstrationError, match="does not exist"):
        summary(tmp_path / "none.h5")


def recorded_by_maniskill(env: Any, folder: Path) -> Path:
    """The file of ManiSkill's recorder of an episode of two steps, of the seed 3."""
    recorder = RecordEpisode(env, str(folder), trajectory_name="theirs", save_video=False)
    recorder.reset(seed=3)
    for _ in range(2):
        recorder.step(recorder.action_space.sample())
    recorder.flush_trajectory()
    recorder._h5_file.close()
    return folder / "theirs.h5"


@pytest.mark.parametrize("obs_mode", ["state", "state+tacff"])
def test_a_file_of_maniskills_recorder_is_sound(make_env, tmp_path, obs_mode, caplog):
    """It has no contact forces, its observations may be vectors, and its id names the module that registers the task."""
    caplog.set_level("INFO")
    theirs = recorded_by_maniskill(make_env(PEG, obs_mode=obs_mode, render_backend="none"), tmp_path)
    assert read_header(theirs)["env_info"]["env_id"] == f"manifeel_ms3:{PEG}"
    page = io.StringIO()
    Console(width=160, file=page).print(summary(theirs))
    assert "2 on average" in page.getvalue()
    assert re.search(r"source +│ not known", page.getvalue())
    assert main(Args(theirs)) == 0  # its replay
    assert "0 of 1 episodes succeed, and 0 did when recorded" in caplog.text
    assert validate(theirs) == ["seed 3: it does not end in success"]


REPLAY = """
from mani_skill.trajectory.replay_trajectory import main, parse_args
main(parse_args(["--traj-path", "theirs.h5", "--save-traj", "--allow-failure"]))
"""


@needs_renderer
def test_maniskill_replays_a_file_of_its_recorder_though_nobody_imports_our_tasks(make_env, tmp_path):
    theirs = recorded_by_maniskill(make_env(PEG, obs_mode="state+tacff"), tmp_path)
    done = run_code(REPLAY, folder=tmp_path)
    assert "1/1=100.00%" in done.stdout, done.stderr
    (again,) = tmp_path.glob("theirs.*.h5")
    first, second = arrays_of(theirs), arrays_of(again)
    poses = [name for name in first if "/env_states/" in name]
    assert poses
    for name in poses:
        np.testing.assert_allclose(second[name], first[name], atol=1e-6, err_msg=name)


@needs_renderer
def test_a_file_of_maniskills_recorder_holds_what_pads_and_cameras_see(make_env, tmp_path):
    theirs = recorded_by_maniskill(make_env(PEG, obs_mode="rgb+tacrgb+tacff"), tmp_path)
    shapes = {name: array.shape for name, array in arrays_of(theirs).items()}
    assert shapes["traj_0/obs/sensor_data/wrist/rgb"] == (3, 256, 256, 3)
    assert shapes["traj_0/obs/sensor_data/tactile_right/rgb"] == (3, 240, 320, 3)
    assert shapes["traj_0/obs/sensor_data/tactile_right/force_field"] == (3, 10, 14, 3)
    assert validate(theirs) == ["seed 3: it does not end in success"]


@pytest.fixture
def old(tmp_path) -> Path:
    """The sample as earlier versions wrote it: `trajectory.h5` has observations, and some of what is known today is missing."""
    path = Path(shutil.copy(SAMPLE, tmp_path / STATES_FILE))
    with h5py.File(path, "r+") as file:
        for trajectory in file.values():
            del trajectory["rewards"], trajectory["env_states/controller/gripper"]
    header = {name: value for name, value in read_header(SAMPLE).items() if name not in ("commit_info", "revision")}
    path.with_suffix(".json").write_text(json.dumps(header))
    return path


def test_a_file_of_an_earlier_version_is_read(old):
    assert observed_file(old.parent) == old
    spec = observation_spec("rgb+tacff", ("wrist",), ("right",), 32)
    np.testing.assert_equal(read_episodes([old], PEG, spec, None), read_episodes([SAMPLE], PEG, spec, None))
    assert validate(old) == []
    page = io.StringIO()
    Console(width=160, file=page).print(summary(old))
    assert f"{PEG}, revision not known" in page.getvalue()
    assert "2, 2 successes" in page.getvalue()


def test_episodes_are_found_by_their_numbers(tmp_path):
    other = renumbered(SAMPLE, tmp_path)
    assert validate(other) == []
    assert all(replayed.success for replayed in replay(other))
    page = io.StringIO()
    Console(width=160, file=page).print(summary(other))
    lengths = [episode["elapsed_steps"] for episode in read_header(SAMPLE)["episodes"]]
    assert lengths[0] != lengths[1]
    assert [len(read_streams(other, i).series["actions"][1]) for i in range(2)] == lengths
    with open_trajectories(SAMPLE) as file:
        peak = file["traj_0/contact_force"][()].max()
    assert any(
        row.split("│")[1].strip() == "4" and f" {peak:.1f} " in row for row in page.getvalue().splitlines() if "│" in row
    )


def test_one_file_is_validated_by_itself():
    assert validate(SAMPLE) == []
