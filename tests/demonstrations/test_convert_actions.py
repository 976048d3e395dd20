"""Recordings for other controllers: converted by this package, and from there by ManiSkill's own script."""

import json
import shutil
from pathlib import Path

import h5py
import pytest
from mani_skill.trajectory import replay_trajectory

from manifeel_ms3.demonstrations import render_observations
from manifeel_ms3.demonstrations.formats.maniskill_h5 import read_header
from manifeel_ms3.errors import WorkFailedError
from tests.sample import states_sample
from tests.tasks_and_marks import PEG, needs_renderer

TASK = "ManiFeel-BallSorting-v1"
BARE = dict(obs_mode="none", cameras=(), tactile_sensors=("right",), num=1)


@pytest.fixture(scope="module")
def in_joints(tmp_path_factory) -> Path:
    """A demonstration whose actions are joint positions."""
    out = tmp_path_factory.mktemp("demos") / "trajectory.h5"
    return render_observations.main(render_observations.Args(states_sample(TASK), out, **BARE, control_mode="pd_joint_pos"))


def replayed(path: Path, capsys, *flags: str) -> dict[str, Path]:
    """The files, by ending, that ManiSkill's script writes beside a file for its first episode, which must succeed."""
    before = set(path.parent.iterdir())
    arguments = ["--traj-path", str(path), "--count", "1", *flags]
    replay_trajectory.main(replay_trajectory.parse_args(arguments))
    assert "1/1=100.00%" in capsys.readouterr().out
    return {file.suffix: file for file in set(path.parent.iterdir()) - before}


def test_actions_that_were_converted_to_joints_move_the_objects_as_before(in_joints):
    assert read_header(in_joints)["env_info"]["env_kwargs"]["control_mode"] == "pd_joint_pos"
    with h5py.File(states_sample(TASK)) as first, h5py.File(in_joints) as second:
        assert second["traj_0/actions"].shape[1] == 8
        assert second["traj_0/success"][-1]
        for name, poses in first["traj_0/env_states/actors"].items():
            assert second[f"traj_0/env_states/actors/{name}"][: len(poses), :7] == pytest.approx(poses[:, :7], abs=3e-3)


def test_an_episode_that_fails_with_another_controller_is_left_out(tmp_path, caplog):
    """Without an action for the gripper, no ball is grasped."""
    mode = "pd_ee_delta_pose_fixed_gripper"
    args = render_observations.Args(states_sample(TASK), tmp_path / "t.h5", **BARE, control_mode=mode)
    with pytest.raises(WorkFailedError, match=r"none of the 1 episodes of .* succeeds in this replay"):
        render_observations.main(args)
    assert "the episodes of the seeds [0] do not succeed in this replay" in caplog.text
    assert not (tmp_path / "t.h5").exists()


@needs_renderer
def test_maniskill_converts_controllers_and_observations(in_joints, capsys):
    files = replayed(in_joints, capsys, "--save-traj", "-c", "pd_ee_delta_pose", "-o", "state+tacff", "--record-rewards")
    assert files[".h5"].name == "trajectory.state+tacff.pd_ee_delta_pose.physx_cpu.h5"
    header = json.loads(files[".json"].read_text())
    assert header["env_info"]["env_id"] == f"manifeel_ms3:{TASK}"  # so that the script can replay its own file
    with h5py.File(files[".h5"]) as file:
        assert file["traj_0/obs/sensor_data/tactile_right/force_field"].shape[1:] == (10, 14, 3)
        assert len(file["traj_0/rewards"]) == len(file["traj_0/actions"])


@needs_renderer
@pytest.mark.parametrize("mode", ["pd_ee_pose", "pd_joint_delta_pos", "pd_joint_target_delta_pos"])
def test_maniskill_converts_joint_positions_to_every_mode_that_it_knows(mode, in_joints, capsys):
    """Its other conversion, from `pd_joint_delta_pos`, fails in ManiSkill 3.0.1, which clips arrays as tensors there."""
    files = replayed(in_joints, capsys, "--save-traj", "-c", mode)
    assert read_header(files[".h5"])["env_info"]["env_kwargs"]["control_mode"] == mode


@needs_renderer
@pytest.mark.parametrize("flag", ["--use-first-env-state", "--use-env-states"])
def test_maniskill_replays_from_recorded_states(flag, tmp_path, capsys):
    for suffix in (".h5", ".json"):
        shutil.copy(states_sample(PEG).with_suffix(suffix), tmp_path / f"trajectory{suffix}")
    replayed(tmp_path / "trajectory.h5", capsys, flag, "-o", "rgb+tacff")
