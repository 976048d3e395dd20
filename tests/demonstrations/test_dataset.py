"""The full data set: every episode with and without observations, a manifest, and the validation of both."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from manifeel_ms3.demonstrations import DemonstrationError, dataset, record, render_observations, replay, summary, validate
from manifeel_ms3.demonstrations.formats.maniskill_h5 import read_header
from manifeel_ms3.errors import InvalidArgumentError, MachineError
from manifeel_ms3.paths import data_dir
from manifeel_ms3.tasks.registry import all_tasks, task_spec
from tests.sample import states_sample
from tests.tasks_and_marks import PEG, needs_renderer
from tests.trajectories import arrays_of, bytes_of

SEARCH = "ManiFeel-ObjectSearch-v1"
STATES, OBSERVED = "trajectory.h5", "trajectory.tacff.pd_ee_delta_pose_fixed_gripper.physx_cpu.h5"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("set")
    dataset.main(dataset.Args(out, (PEG,), num=2, obs_mode="tacff", cameras=(), tactile_sensors=("right",)))
    return out


def test_states_are_small_and_observations_are_beside_them(folder):
    states, trajectory = folder / PEG / STATES, folder / PEG / OBSERVED
    assert states.stat().st_size / 2 < 0.5e6
    bare, full = arrays_of(states), arrays_of(trajectory)
    assert not any("/obs/" in name for name in bare)
    assert any(name.endswith("tactile_right/force_field") for name in full)
    for name, values in bare.items():
        assert np.array_equal(full[name], values), name


def test_manifest_says_what_is_there(folder):
    files = json.loads((folder / "manifest.json").read_text())["files"]
    assert set(files) == {f"{PEG}/{STATES}", f"{PEG}/{OBSERVED}"}
    for entry in files.values():
        assert entry["seeds"] == [0, 1]
        assert entry["success"] == 2
        assert entry["env_id"] == PEG
        assert {"mani-skill", "sapien"} <= set(entry["versions"])
    assert validate.validate(folder, num_replays=1) == []


def test_same_command_again_does_nothing(folder):
    before = (folder / PEG / OBSERVED).stat().st_mtime_ns
    dataset.main(dataset.Args(folder, (PEG,), num=2, obs_mode="tacff", cameras=(), tactile_sensors=("right",)))
    assert (folder / PEG / OBSERVED).stat().st_mtime_ns == before
    assert not list(folder.rglob("*.episodes"))


def test_only_episodes_that_are_not_there_yet_need_room(folder, monkeypatch):
    room = 1.5e6 * task_spec(PEG).demo_megabytes * dataset.SMALLEST_SHARE  # for one more episode without images
    monkeypatch.setattr(dataset.shutil, "disk_usage", lambda path: type("Usage", (), dict(free=room)))
    sensing = dict(obs_mode="tacff", cameras=(), tactile_sensors=("right",))
    dataset.main(dataset.Args(folder, (PEG,), num=2, **sensing))
    with pytest.raises(MachineError, match="2 more episodes take up to"):
        dataset.main(dataset.Args(folder, (PEG,), num=4, **sensing))


def test_no_more_episodes_are_rendered_than_are_asked_for(folder, tmp_path):
    states = tmp_path / PEG / STATES
    states.parent.mkdir()
    for suffix in (".h5", ".json"):
        shutil.copy((folder / PEG / STATES).with_suffix(suffix), states.with_suffix(suffix))
    dataset.main(dataset.Args(tmp_path, (PEG,), num=1, obs_mode="tacff", cameras=(), tactile_sensors=("right",)))
    assert [len(read_header(path)["episodes"]) for path in (states, tmp_path / PEG / OBSERVED)] == [2, 1]


@pytest.mark.parametrize("given", [0, -1])
def test_numbers_that_are_too_small_are_refused(folder, tmp_path, given):
    states, small = folder / PEG / STATES, f"{given} must be at least 1"
    with pytest.raises(InvalidArgumentError, match=f"--num-demos {small}"):
        dataset.main(dataset.Args(tmp_path / "set", (PEG,), num=given))
    with pytest.raises(InvalidArgumentError, match=f"--num-demos {small}"):
        render_observations.main(render_observations.Args(states, tmp_path / "rendered.h5", num=given))
    with pytest.raises(InvalidArgumentError, match=f"--image-size {small}"):
        render_observations.main(render_observations.Args(states, tmp_path / "rendered.h5", image_size=given))
    with pytest.raises(InvalidArgumentError, match=f"--num-demos {small}"):
        replay.main(replay.Args(states, num=given))
    with pytest.raises(InvalidArgumentError, match=f"--max-tries {small}"):
        record.main(record.Args(PEG, 1, out=tmp_path / "recorded.h5", max_tries=given))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (dict(obs_mode="rgb+foo"), "token 'foo' is unknown"),
        (dict(cameras=("foo",)), "--cameras='foo'"),
        (dict(tactile_sensors=("middle",)), "--tactile-sensors='middle'"),
    ],
)
def test_unknown_observations_are_refused_before_anything_is_recorded(tmp_path, flags, said):
    with pytest.raises(InvalidArgumentError, match=said):
        dataset.main(dataset.Args(tmp_path / "set", (PEG,), num=1, **flags))
    assert not list(tmp_path.iterdir())


def test_a_tasks_own_camera_is_recorded_unless_others_are_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr(task_spec(PEG).env_class, "own_cameras", ("above",))
    assert record.Args(PEG).all_env_kwargs["cameras"] == ["front", "side", "wrist", "above"]
    assert record.Args(PEG, cameras=("side",)).all_env_kwargs["cameras"] == ["side"]
    with pytest.raises(
        InvalidArgumentError, match=r"--cameras='foo' is unknown; choose from \['front', 'side', 'wrist', 'above'\]"
    ):
        dataset.main(dataset.Args(tmp_path / "set", (PEG,), num=1, cameras=("foo",)))


def test_negative_numbers_of_what_may_be_left_out_are_refused(folder):
    states = folder / PEG / STATES
    with pytest.raises(InvalidArgumentError, match="--replay -1 must be at least 0"):
        validate.main(validate.Args(states, replay=-1))
    with pytest.raises(InvalidArgumentError, match="--episodes -1 must be at least 0"):
        summary.main(summary.Args(states, episodes=-1))


def damaged(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def test_a_changed_action_is_found(folder, tmp_path):
    copy = damaged(folder, tmp_path)
    with h5py.File(copy / PEG / STATES, "r+") as file:
        file["traj_1/actions"][3, 0] = 0.123
    problems = validate.validate(copy, num_replays=2)
    assert any("sha256" in problem for problem in problems)
    assert any("seed 1 does not come out as recorded" in problem for problem in problems)


def first_array(file: h5py.File, name: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    values = change(file[f"traj_0/{name}"][()])
    del file[f"traj_0/{name}"]
    file[f"traj_0/{name}"] = values


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("actions", lambda values: 1.5 * values / np.abs(values).max(), "seed 0: an action is beyond its limits"),
        ("actions", lambda values: np.append(values[:-1], np.nan + values[-1:], axis=0), "seed 0: actions holds NaN"),
        ("actions", lambda values: values[:-1], r"seed 0: actions has \d+ entries instead of \d+"),
        ("env_states/actors/peg", lambda values: values[:-1], r"seed 0: env_states/actors/peg has \d+ entries instead"),
        ("env_states/actors/peg", lambda values: values + np.inf, "seed 0: env_states/actors/peg holds NaN or infinite"),
        ("success", lambda values: values & False, "seed 0: it does not end in success"),
    ],
)
def test_what_is_wrong_with_the_arrays_of_an_episode_is_said(tmp_path, name, change, said):
    copy = copy_of_the_sample(tmp_path)
    with h5py.File(copy, "r+") as file:
        first_array(file, name, change)
    (problem,) = validate.validate(copy)
    assert re.match(said, problem)


@pytest.mark.parametrize(
    ("seeds", "said"),
    [((0, 0), "a seed occurs twice"), ((0, 100_000), r"seeds \[100000\] are evaluation seeds"), ((0, 99_999), None)],
)
def test_seeds_that_no_demonstrations_may_have_are_said(tmp_path, seeds, said):
    copy = copy_of_the_sample(tmp_path)
    header = json.loads(copy.with_suffix(".json").read_text())
    for episode, seed in zip(header["episodes"], seeds, strict=True):
        episode["episode_seed"] = seed
    copy.with_suffix(".json").write_text(json.dumps(header))
    problems = validate.validate(copy)
    assert len(problems) == (said is not None)
    assert said is None or re.match(said, problems[0])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda episodes: episodes.pop(), r"it holds \['traj_1'\], which its json file does not name"),
        (lambda episodes: episodes[0].update(success=False), "seed 0: it ends in success, and its json file says that it does"),
    ],
    ids=["an episode less", "another outcome"],
)
def test_a_json_file_of_another_recording_is_said(tmp_path, change, said):
    copy = copy_of_the_sample(tmp_path)
    header = json.loads(copy.with_suffix(".json").read_text())
    change(header["episodes"])
    copy.with_suffix(".json").write_text(json.dumps(header))
    (problem,) = validate.validate(copy)
    assert re.match(said, problem)


def copy_of_the_sample(tmp_path: Path) -> Path:
    for suffix in (".json", ".h5"):
        copy = Path(shutil.copy(states_sample(PEG).with_suffix(suffix), tmp_path / f"trajectory{suffix}"))
    assert validate.validate(copy) == []
    return copy


def test_a_replay_that_rounds_differently_is_kept_with_its_own_states_and_one_that_fails_is_left_out(folder, tmp_path, caplog):
    states, rendered = damaged(folder, tmp_path) / PEG / STATES, tmp_path / "rendered.h5"
    with h5py.File(states, "r+") as file:
        file["traj_0/env_states/actors/peg"][-1, 0] += 1e-3  # as another processor would have recorded it
        file["traj_1/actions"][:, 2] = 1.0  # the hand rises
    render_observations.main(render_observations.Args(states, rendered, "tacff", ()))
    (episode,) = read_header(rendered)["episodes"]
    assert episode["episode_seed"] == 0
    assert episode["replay_deviation"] == pytest.approx(1e-3, rel=1e-3)
    assert "1 of 1 episodes succeed, but not bit for bit" in caplog.text
    assert "the episodes of the seeds [1] do not succeed in this replay and are left out" in caplog.text
    with h5py.File(states) as before, h5py.File(rendered) as after:
        moved = after["traj_0/env_states/actors/peg"][()] - before["traj_0/env_states/actors/peg"][()]
    assert np.abs(moved[:-1]).max() == 0.0
    assert moved[-1, 0] == pytest.approx(-1e-3, rel=1e-3)


def test_episodes_that_were_rendered_from_another_recording_are_refused(folder, tmp_path):
    states, rendered = damaged(folder, tmp_path) / PEG / STATES, tmp_path / "rendered.h5"
    args = render_observations.Args(states, rendered, "tacff", (), num=1)
    render_observations.main(args)
    before = bytes_of(rendered)
    assert render_observations.main(args) == rendered  # the same recording: nothing is left to do
    with h5py.File(states, "r+") as file:
        file["traj_0/actions"][:, 0] *= 0.999
    for num in (1, 2):
        with pytest.raises(DemonstrationError, match=r"holds the seeds \[0\] with other actions than .* give another --out"):
            render_observations.main(replace(args, num=num))
    assert bytes_of(rendered) == before


def test_a_replay_that_ends_earlier_is_compared_as_far_as_it_goes(folder, tmp_path):
    states = damaged(folder, tmp_path) / PEG / STATES
    with h5py.File(states, "r+") as file:
        for name, values in arrays_of(states).items():
            if name.startswith("traj_0/"):
                del file[name]
                file[name] = np.concatenate([values, values[-1:]])  # as another processor would have recorded it
    header = read_header(states)
    header["episodes"][0]["elapsed_steps"] += 1
    states.with_suffix(".json").write_text(json.dumps(header))
    render_observations.main(render_observations.Args(states, tmp_path / "rendered.h5", "tacff", (), num=1))
    (recorded, _), (episode,) = (read_header(path)["episodes"] for path in (states, tmp_path / "rendered.h5"))
    assert episode["elapsed_steps"] == recorded["elapsed_steps"] - 1
    assert episode["replay_deviation"] == 0.0


def test_a_rendered_file_says_who_acted_and_with_which_versions(folder, tmp_path):
    states, rendered = damaged(folder, tmp_path) / PEG / STATES, tmp_path / "rendered.h5"
    header = read_header(states)
    added = dict(source_type="scripted", source_desc="a script", versions=dict(sapien="0.2"))
    header |= dict(source_type="human", source_desc="a person", versions=dict(sapien="0.1"))
    header["episodes"][1] |= added
    states.with_suffix(".json").write_text(json.dumps(header))
    render_observations.main(render_observations.Args(states, rendered, "tacff", ()))
    found = read_header(rendered)
    assert (found["source_type"], found["source_desc"], found["recorded_with"]) == ("human", "a person", dict(sapien="0.1"))
    first, second = found["episodes"]
    assert not first.keys() & {"source_type", "source_desc", "recorded_with", "versions"}
    assert (second["source_type"], second["source_desc"], second["recorded_with"]) == tuple(added.values())
    assert "versions" not in second  # both were rendered with these


def test_a_quaternion_of_the_other_sign_is_the_same_rotation(folder, tmp_path):
    copy = damaged(folder, tmp_path)
    with h5py.File(copy / PEG / STATES, "r+") as file:
        for states in file["traj_0/env_states/actors"].values():
            states[:, 3:7] *= -1
    assert replay.replay(copy / PEG / STATES, 1)[0].deviation == 0.0
    render_observations.main(render_observations.Args(copy / PEG / STATES, tmp_path / "rendered.h5", "tacff", (), num=1))
    (episode,) = read_header(tmp_path / "rendered.h5")["episodes"]
    assert "replay_deviation" not in episode


def test_another_size_of_images_keeps_the_other_settings_of_the_recorded_sensors(tmp_path):
    pad = dict(units="tacsl")
    configs = dict(shader_pack="minimal", wrist=dict(width=64, fov=1.0), tactile_right=pad)
    kwargs = json.dumps(dict(fit="paper", render_backend="none", sensor_configs=configs))
    sensing = dict(obs_mode="tacff", cameras=("wrist",), tactile_sensors=("right",))
    recorded = record.main(record.Args(PEG, 1, out=tmp_path / "recorded.h5", **sensing, env_kwargs=kwargs))
    rendered = tmp_path / "rendered.h5"
    render_observations.main(render_observations.Args(recorded, rendered, **sensing, image_size=128))
    size = dict(width=128, height=128)
    expected = dict(shader_pack="minimal", **size, wrist=dict(fov=1.0, **size), tactile_right=pad)
    assert read_header(rendered)["env_info"]["env_kwargs"]["sensor_configs"] == expected


def test_states_of_another_task_are_refused(folder, tmp_path):
    states = damaged(folder, tmp_path) / PEG / STATES
    with h5py.File(states, "r+") as file:
        del file["traj_0/env_states/actors/peg"]
    with pytest.raises(DemonstrationError, match="has no states of peg at every step"):
        render_observations.main(render_observations.Args(states, tmp_path / "rendered.h5", "tacff", ()))


def test_a_merged_file_with_two_episodes_of_a_seed_is_refused_rather_than_rendered_in_part(tmp_path):
    copy = Path(shutil.copy(states_sample(PEG), tmp_path / STATES))
    header = json.loads(states_sample(PEG).with_suffix(".json").read_text())
    first, second = header["episodes"]
    second["episode_seed"] = first["episode_seed"]
    copy.with_suffix(".json").write_text(json.dumps(header))
    with pytest.raises(DemonstrationError, match="holds 2 episodes of 1 seeds"):
        render_observations.main(render_observations.Args(copy, tmp_path / "rendered.h5", "tacff", ()))
    assert not (tmp_path / "rendered.h5").exists()


def test_a_truncated_file_and_a_missing_one_are_found(folder, tmp_path):
    copy = damaged(folder, tmp_path)
    whole = (copy / PEG / STATES).read_bytes()
    (copy / PEG / STATES).write_bytes(whole[: len(whole) // 2])
    (copy / PEG / OBSERVED).unlink()
    problems = validate.validate(copy)
    assert any(STATES in problem and "truncated" in problem for problem in problems)
    assert any(OBSERVED in problem and "does not exist" in problem for problem in problems)


def test_an_unknown_key_of_a_manifest_is_named_and_hides_no_other_fault(folder, tmp_path):
    copy = damaged(folder, tmp_path)
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["files"][f"{PEG}/{STATES}"] |= dict(licence="MIT", success=1)
    (copy / "manifest.json").write_text(json.dumps(manifest))
    unknown, differing = validate.validate(copy)
    assert unknown.startswith(f"{PEG}/{STATES}: the manifest has the unknown key 'licence'")
    assert differing == f"{PEG}/{STATES}: success is 2, the manifest says 1"


@pytest.mark.parametrize("kept", [{}, dict(success=2)])
def test_a_manifest_without_hashes_checks_nothing_and_is_a_fault(kept, folder, tmp_path):
    copy = damaged(folder, tmp_path)
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["files"] = {f"{PEG}/{STATES}": kept}
    (copy / "manifest.json").write_text(json.dumps(manifest))
    assert [problem.split("; ")[0] for problem in validate.validate(copy)] == [
        f"{PEG}/{STATES}: the manifest does not say its {key}" for key in ("sha256", "json_sha256")
    ]


def test_a_set_may_hold_files_that_do_not_say_versions_and_forces(folder, tmp_path):
    copy = damaged(folder, tmp_path)
    header = json.loads((copy / PEG / STATES).with_suffix(".json").read_text())
    del header["versions"], header["episodes"][0]["peak_contact_force"]
    (copy / PEG / STATES).with_suffix(".json").write_text(json.dumps(header))
    dataset.write_manifest(copy)
    entry = json.loads((copy / "manifest.json").read_text())["files"][f"{PEG}/{STATES}"]
    assert (entry["versions"], entry["peak_contact_force"]) == (None, None)
    assert validate.validate(copy) == []


def test_faults_are_said_beside_a_replay_that_is_not_possible(folder, tmp_path):
    assert validate.validate(folder / PEG / STATES, num_replays=10) == []  # the file has two episodes
    copy = copy_of_the_sample(tmp_path)
    header = json.loads(copy.with_suffix(".json").read_text())
    copy.with_suffix(".json").write_text(json.dumps(header | dict(revision=1)))
    with h5py.File(copy, "r+") as file:
        first_array(file, "success", lambda values: values & False)
    found, not_replayed = validate.validate(copy, num_replays=1)
    assert found == "seed 0: it does not end in success"
    assert "revision 1" in not_replayed


def test_a_file_of_maniskills_tools_is_replayed_without_their_renderer(tmp_path):
    copy = copy_of_the_sample(tmp_path)
    header = json.loads(copy.with_suffix(".json").read_text())
    header["env_info"]["env_kwargs"] |= dict(render_mode="rgb_array", human_render_camera_configs=dict(width=32))
    copy.with_suffix(".json").write_text(json.dumps(header))
    assert [replayed.success for replayed in replay.replay(copy, 1)] == [True]


@pytest.mark.parametrize(
    ("asked", "megabytes"),
    [
        (dict(), 1.0),
        (dict(cameras=("wrist",), tactile_sensors=("right",)), 0.4),
        (dict(obs_mode="tacrgb"), 0.4),
        (dict(obs_mode="tacff"), 0.2),
        (dict(obs_mode="rgbd"), 1.2),
        (dict(obs_mode="depth"), 0.6),
        (dict(image_size=128), 0.55),
    ],
)
def test_the_room_that_is_needed_follows_from_the_images_that_are_asked_for(tmp_path, monkeypatch, asked, megabytes):
    needed = 100 * megabytes * task_spec(PEG).demo_megabytes * 1e6
    args = dataset.Args(tmp_path, (PEG,), **asked)
    free = [0.99 * needed, 1.01 * needed]
    monkeypatch.setattr(dataset.shutil, "disk_usage", lambda path: type("Usage", (), dict(free=free[0])))
    with pytest.raises(MachineError, match="GB free"):
        dataset._check_room(args, {PEG: 100})
    free.pop(0)
    dataset._check_room(args, {PEG: 100})


def test_set_without_manifest_says_what_writes_one(tmp_path):
    with pytest.raises(DemonstrationError, match="manifeel dataset"):
        validate.validate(tmp_path)


def test_a_file_that_is_missing_is_said_rather_than_a_manifest(tmp_path):
    (problem,) = validate.validate(tmp_path / "absent.h5")
    assert "absent.h5 does not exist" in problem


def test_bad_arguments_say_what_is_wrong(tmp_path, folder, monkeypatch):
    with pytest.raises(ValueError, match="Juggling"):
        dataset.main(dataset.Args(tmp_path, ("ManiFeel-Juggling-v1",)))
    monkeypatch.setattr(dataset.shutil, "disk_usage", lambda path: type("Usage", (), dict(free=1e6)))
    with pytest.raises(MachineError, match=r"0\.0 GB free"):
        dataset.main(dataset.Args(tmp_path, (PEG,)))
    states = folder / PEG / STATES
    with pytest.raises(ValueError, match="is the file that is read"):
        render_observations.main(render_observations.Args(states, states))


@needs_renderer
def test_rendered_observations_are_those_of_the_recording(tmp_path):
    """Observations are the same bits whether they are recorded at once or rendered from states and actions."""
    kwargs = dict(seed=3, cameras=("front",), tactile_sensors=("right",))
    direct = record.main(record.Args(SEARCH, 1, out=tmp_path / "direct.h5", obs_mode="rgb+tacrgb+tacff", **kwargs))
    bare = record.main(
        record.Args(SEARCH, 1, seed=3, out=tmp_path / "bare.h5", obs_mode="none", cameras=(), tactile_sensors=())
    )
    again = render_observations.main(
        render_observations.Args(bare, tmp_path / "again.h5", cameras=("front",), tactile_sensors=("right",))
    )
    first, second = arrays_of(direct), arrays_of(again)
    assert set(first) == set(second)
    for name, values in first.items():
        assert np.array_equal(second[name], values), name
    assert read_header(direct)["env_info"] == read_header(again)["env_info"]


def test_sample_is_sound():
    """The sample in data/: two episodes of every task."""
    assert validate.validate(data_dir() / "sample") == []
    files = json.loads((data_dir() / "sample" / "manifest.json").read_text())["files"]
    assert {entry["env_id"] for entry in files.values()} == set(all_tasks())
    assert all(len(entry["seeds"]) == 2 for entry in files.values())
