"""Recording: reproducible, crash-safe, resumable; files that say what is wrong with them."""

import io
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import psutil
import pytest
from rich.console import Console

from manifeel_ms3.demonstrations import (
    DemonstrationError,
    dataset,
    read_demonstrations,
    record,
    render_observations,
    replay,
    view,
)
from manifeel_ms3.demonstrations.formats.lerobot_card import card
from manifeel_ms3.demonstrations.formats.maniskill_h5 import ORIGIN, observation_keys, read_header
from manifeel_ms3.demonstrations.formats.maniskill_h5_writing import RecordedEpisode, episode_folder, write_episode
from manifeel_ms3.demonstrations.recording import make_header, open_recording, trajectory_name
from manifeel_ms3.demonstrations.summary import summary
from manifeel_ms3.demonstrations.validate import validate
from manifeel_ms3.errors import InvalidArgumentError, ManifeelError, WorkFailedError
from manifeel_ms3.provenance import git_commit
from manifeel_ms3.tasks import registry
from manifeel_ms3.tasks.registry import FIRST_EVALUATION_SEED, TaskSpec, task_spec
from tests.sample import observed_sample, states_sample
from tests.tasks_and_marks import PEG
from tests.trajectories import bytes_of, renumbered
from tests.trust.kills import worker_processes

EASY = dict(fit="paper", render_backend="none")
KEYS = ["sensor_data/tactile_right/force_field", "extra/tcp_pose"]


def run(path: Path, num: int, workers: int = 1, obs_mode: str = "tacff", seed: int = 0) -> Path:
    args = record.Args(
        PEG, num, workers, seed, path, obs_mode, cameras=(), tactile_sensors=("right",), env_kwargs=json.dumps(EASY)
    )
    return record.main(args)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    return run(tmp_path_factory.mktemp("demos") / "trajectory.h5", num=3)


def test_file_holds_what_maniskill_expects(recorded):
    header = json.loads(recorded.with_suffix(".json").read_text())
    assert header["env_info"]["env_id"].endswith(PEG)
    assert [episode["episode_id"] for episode in header["episodes"]] == [0, 1, 2]
    with h5py.File(recorded) as file:
        for episode in header["episodes"]:
            group, steps = file[f"traj_{episode['episode_id']}"], episode["elapsed_steps"]
            assert group["actions"].shape == (steps, 6)
            assert group["success"].shape == (steps,)
            assert group["success"][-1]
            assert group["rewards"].shape == (steps,)
            assert group["rewards"].dtype == np.float32
            assert 0.5 < group["rewards"][-1] <= 1.0
            assert group["obs/sensor_data/tactile_right/force_field"].shape == (steps + 1, 10, 14, 3)
            assert group["env_states/actors/peg"].shape[0] == steps + 1
            assert 5 < episode["peak_contact_force"] < 60
            assert episode["peak_contact_force"] == pytest.approx(group["contact_force"][()].max(), abs=1e-3)
    assert not episode_folder(recorded).exists()
    assert header["commit_info"] == (git_commit() and dict(commit_id=git_commit()))


def test_another_sensor_is_recorded_and_named(recorded, tmp_path):
    sensing = dict(obs_mode="tacff", cameras=(), tactile_sensors=("right",), sensor="digit")
    path = record.main(record.Args(PEG, 1, 1, 0, tmp_path / "digit.h5", **sensing, env_kwargs=json.dumps(EASY)))
    assert json.loads(path.with_suffix(".json").read_text())["env_info"]["env_kwargs"]["sensor"] == "digit"
    with h5py.File(path) as digit, h5py.File(recorded) as other:
        first, r15 = (file["traj_0/obs"][KEYS[0]][0] for file in (digit, other))
    assert first[..., 0].sum() == pytest.approx(r15[..., 0].sum(), rel=0.05)  # the same grip at the same start
    assert np.abs(first - r15).max() > 0.02  # N: the domed gel spreads it otherwise


def test_vectors_of_states_are_recorded_as_observations(tmp_path):
    path = run(tmp_path / "state.h5", num=1, obs_mode="state")
    assert validate(path) == []
    (episode,) = read_header(path)["episodes"]
    with h5py.File(path) as file:
        states = file["traj_0/obs"][()]
    assert states.shape[0] == episode["elapsed_steps"] + 1
    assert np.ptp(states, axis=0).max() > 0.01  # the hand moves
    assert "actions" in view.read_streams(path, 0).series
    with pytest.raises(DemonstrationError, match=r"lacks \['sensor_data/wrist/rgb'\]"):
        read_demonstrations(path, ["sensor_data/wrist/rgb"], PEG)
    with pytest.raises(DemonstrationError, match="render-observations"):
        observation_keys(path)


def test_names_of_files_say_what_is_in_them():
    def name(obs_mode: str, **kwargs) -> str:
        return record.Args(PEG, obs_mode=obs_mode, env_kwargs=json.dumps(kwargs)).path.relative_to("data/demos").as_posix()

    assert name("none") == f"{PEG}/trajectory.h5"
    assert name("rgb+tacff") == f"{PEG}/trajectory.rgb+tacff.pd_ee_delta_pose_fixed_gripper.physx_cpu.h5"
    assert name("state", control_mode="pd_ee_delta_pose") == f"{PEG}/trajectory.state.pd_ee_delta_pose.physx_cpu.h5"
    in_holder = dict(obs_mode="state", start="holder")
    assert trajectory_name("ManiFeel-BulbInstallation-v1", in_holder) == "trajectory.state.pd_ee_delta_yaw.physx_cpu.h5"


def test_more_episodes_than_a_file_holds_are_refused(tmp_path):
    with pytest.raises(DemonstrationError, match="holds 2 episodes, 99 are wanted"):
        replay.replay(observed_sample(PEG), 99)
    with pytest.raises(DemonstrationError, match="holds 2 episodes, 99 are wanted"):
        render_observations.main(render_observations.Args(observed_sample(PEG), tmp_path / "o.h5", num=99))


def test_a_file_says_the_time_limit_of_its_episodes():
    def limit(**kwargs) -> int:
        return make_header(PEG, dict(obs_mode="none") | kwargs)["env_info"]["max_episode_steps"]

    assert (limit(), limit(max_episode_steps=400)) == (task_spec(PEG).max_episode_steps, 400)


def wait_for_an_episode(path: Path) -> None:
    """Wait until a recording, which begins with an empty file, holds an episode."""
    for _ in range(600):
        if path.is_file() and read_header(path)["episodes"]:
            return
        time.sleep(0.1)
    raise AssertionError(f"{path} holds no episode after a minute")


def test_any_number_of_workers_gives_the_same_episodes(recorded, tmp_path):
    two = run(tmp_path / "trajectory.h5", num=3, workers=2)
    assert bytes_of(two) == bytes_of(recorded)


def test_every_episode_succeeds_again_from_its_actions(recorded):
    results = replay.replay(recorded)
    assert all(result.success for result in results)
    assert max(result.deviation for result in results) == 0.0


def test_an_observation_is_that_before_its_action(recorded, make_env):
    env = make_env(**EASY, obs_mode="tacff", tactile_sensors=("right",))
    obs, _ = env.reset(seed=1)
    (_, episode), actions = read_demonstrations(recorded, KEYS, PEG, num=2), []
    for step in range(12):
        for key in KEYS:
            expected = obs
            for part in key.split("/"):
                expected = expected[part]
            assert np.array_equal(episode[key][step], expected[0]), (key, step)
        actions.append(episode["actions"][step])
        obs, *_ = env.step(actions[-1])
    assert np.abs(actions).max() > 0.1  # the hand moves


def test_an_episode_that_fails_is_not_recorded_but_remembered(recorded, tmp_path):
    """The demonstration of seed 0 is longer than that of seed 1, and than the time limit here."""
    first, second, _ = (episode["elapsed_steps"] for episode in read_header(recorded)["episodes"])
    assert first > second
    kwargs = json.dumps(EASY | dict(max_episode_steps=second))
    path = record.main(record.Args(PEG, 1, out=tmp_path / "t.h5", obs_mode="none", env_kwargs=kwargs))
    header = read_header(path)
    assert ([episode["episode_seed"] for episode in header["episodes"]], header["failed_seeds"]) == ([1], [0])
    with h5py.File(path) as file:
        assert list(file) == ["traj_0"]
        assert file["traj_0/success"][-1]
    with pytest.raises(WorkFailedError, match=r"1 seeds were tried and 0 of 1 episodes succeeded"):
        record.main(record.Args(PEG, 1, out=tmp_path / "u.h5", obs_mode="none", env_kwargs=kwargs, max_tries=1))


def test_more_can_be_recorded_later(recorded, tmp_path):
    path = run(tmp_path / "trajectory.h5", num=2)
    assert len(read_header(path)["episodes"]) == 2
    run(path, num=3)
    assert bytes_of(path) == bytes_of(recorded)


def test_killed_run_keeps_every_finished_episode_and_goes_on(recorded, tmp_path):
    path = tmp_path / "trajectory.h5"
    command = [
        sys.executable,
        "-m",
        "manifeel_ms3.demonstrations.record",
        PEG,
        "-n",
        "3",
        "--out",
        str(path),
        "--obs-mode",
        "tacff",
    ]
    command += ["--cameras", "--tactile-sensors", "right", "--env-kwargs", json.dumps(EASY)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    wait_for_an_episode(path)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    finished = read_demonstrations(path, KEYS, PEG)
    assert 1 <= len(finished) <= 3
    run(path, num=3)
    assert bytes_of(path) == bytes_of(recorded)


def test_other_settings_do_not_mix_into_a_file(recorded):
    with pytest.raises(DemonstrationError, match="another --out"):
        run(recorded, num=4, obs_mode="none")


def add_episode(path: Path, seed: int, header: dict, finish: bool = True) -> None:
    """Add a tiny episode to a file, in a recording session with this header, which is killed if it does not finish."""
    with open_recording(path, header) as recording:
        recording.begin()
        for kept in list(recording.kept):
            recording.accept_kept(kept)
        arrays = dict(actions=np.zeros((2, 6)), success=np.ones(2, bool))
        write_episode(recording.drafts, RecordedEpisode(seed, arrays))
        recording.accept(seed, dict(elapsed_steps=2, success=True))
        if finish:
            recording.finish()


@pytest.mark.parametrize("finish", [True, False])
def test_a_file_that_is_continued_says_who_recorded_each_episode(tmp_path, finish):
    path, now = tmp_path / "trajectory.h5", make_header(PEG, dict(obs_mode="none"))
    before = now | dict(versions={"manifeel-ms3": "0.0.9"}, commit_info=dict(commit_id="0" * 40), source_type="human")
    for seed, header in enumerate((before, before, now, before)):
        add_episode(path, seed, header, finish or seed == 3)
    held = read_header(path)
    differing = {name: now[name] for name in ("versions", "commit_info", "source_type")}
    entries = [{name: value for name, value in episode.items() if name in ORIGIN} for episode in held["episodes"]]
    assert {name: held[name] for name in differing} == {name: before[name] for name in differing}
    assert entries == [{}, {}, differing, {}]
    assert validate(path) == []
    page = io.StringIO()
    Console(width=200, file=page).print(summary(path))
    assert "human, scripted" in page.getvalue()
    described = dataset.describe(path)["versions"]
    assert described["manifeel-ms3"] == f"0.0.9, {now['versions']['manifeel-ms3']}"
    told = card(
        held, [], "Insert the peg.", dict(total_episodes=4, total_frames=8, fps=10, codebase_version="v3.0", features={})
    )
    assert f"manifeel_ms3 {described['manifeel-ms3']} " in told


def test_a_file_with_other_numbers_of_episodes_can_be_continued(tmp_path):
    path, header = renumbered(states_sample(PEG), tmp_path), read_header(states_sample(PEG))
    add_episode(path, 9, {name: value for name, value in header.items() if name != "episodes"})
    assert [(episode["episode_id"], episode["episode_seed"]) for episode in read_header(path)["episodes"]] == [
        *((i, episode["episode_seed"]) for i, episode in enumerate(header["episodes"])),
        (2, 9),
    ]
    before, after = bytes_of(states_sample(PEG)), bytes_of(path)
    assert {name: after[name] for name in before} == before


def test_a_file_without_episodes_is_of_the_session_that_records_into_it(tmp_path):
    path, header = tmp_path / "trajectory.h5", make_header(PEG, dict(obs_mode="none"))
    with open_recording(path, header | dict(source_type="human")) as recording:
        recording.begin()
    add_episode(path, 0, header)
    held = read_header(path)
    assert held["source_type"] == "scripted"
    assert "source_type" not in held["episodes"][0]


@pytest.mark.parametrize("error", [KeyboardInterrupt, InvalidArgumentError])
def test_a_session_that_ends_before_its_first_episode_leaves_no_file(tmp_path, error):
    """The same command with other arguments would be refused because of it."""
    path = tmp_path / "trajectory.h5"

    def end_at_once(env_kwargs: dict) -> None:
        with open_recording(path, make_header(PEG, env_kwargs)) as recording:
            recording.begin()
            raise error

    with pytest.raises(error):
        end_at_once(dict(obs_mode="none", fit="tight"))
    add_episode(path, 0, make_header(PEG, dict(obs_mode="none")))
    with pytest.raises(error):
        end_at_once(dict(obs_mode="none"))
    assert [episode["episode_seed"] for episode in read_header(path)["episodes"]] == [0]


@pytest.mark.parametrize(("first", "num"), [(5000, 3), (5000, 4), (1, 3)])
def test_episodes_of_other_seeds_are_neither_returned_nor_mixed_in(recorded, first, num):
    before = bytes_of(recorded)
    with pytest.raises(DemonstrationError, match=f"episodes of the seeds 0 to .*from {first} on; give another --out"):
        run(recorded, num, seed=first)
    assert bytes_of(recorded) == before


def test_a_held_out_file_is_not_taken_for_the_training_set(tmp_path):
    path = tmp_path / "trajectory.h5"
    env_kwargs = record.Args(PEG, obs_mode="none", cameras=(), tactile_sensors=(), env_kwargs=json.dumps(EASY)).all_env_kwargs
    add_episode(path, 5000, make_header(PEG, env_kwargs))
    with pytest.raises(DemonstrationError, match="holds episodes of the seeds 5000 to 5000"):
        record.main(record.Args(PEG, 1, 1, 0, path, "none", (), (), env_kwargs=json.dumps(EASY)))


def test_fewer_episodes_than_a_file_holds_may_be_asked_for_where_many_seeds_failed(tmp_path):
    path, seeds = tmp_path / "trajectory.h5", (0, 4, 13)
    args = record.Args(PEG, 1, out=path, obs_mode="none", env_kwargs=json.dumps(EASY))
    for seed in seeds:
        add_episode(path, seed, make_header(PEG, args.all_env_kwargs))
    assert record.main(args) == path
    assert [episode["episode_seed"] for episode in read_header(path)["episodes"]] == list(seeds)


def test_reader_gives_actions_and_observations(recorded):
    episodes = read_demonstrations(recorded, KEYS, PEG, num=2)
    assert len(episodes) == 2
    for episode in episodes:
        assert len(episode[KEYS[0]]) == len(episode["actions"]) + 1
        assert np.isfinite(episode[KEYS[0]]).all()


def test_missing_file_says_how_to_record_one(tmp_path):
    with pytest.raises(DemonstrationError, match="manifeel record"):
        read_demonstrations(tmp_path / "none.h5", KEYS)


def test_truncated_file(recorded, tmp_path):
    broken = tmp_path / "trajectory.h5"
    broken.write_bytes(recorded.read_bytes()[: recorded.stat().st_size // 2])
    broken.with_suffix(".json").write_text(recorded.with_suffix(".json").read_text())
    with pytest.raises(DemonstrationError, match="truncated"):
        read_demonstrations(broken, KEYS)


def test_broken_json(recorded, tmp_path):
    broken = tmp_path / "trajectory.h5"
    broken.write_bytes(recorded.read_bytes())
    broken.with_suffix(".json").write_text("{")
    with pytest.raises(DemonstrationError, match="not a trajectory's json"):
        read_demonstrations(broken, KEYS)


def test_other_task(recorded):
    with pytest.raises(DemonstrationError, match=f"of {PEG}, not of ManiFeel-BallSorting-v1"):
        read_demonstrations(recorded, KEYS, "ManiFeel-BallSorting-v1")


def test_other_obs_mode(recorded):
    with pytest.raises(DemonstrationError, match=r"obs_mode='tacff'.*sensor_data/wrist/rgb"):
        read_demonstrations(recorded, ["sensor_data/wrist/rgb"], PEG)


def test_too_few_episodes(recorded):
    with pytest.raises(DemonstrationError, match="holds 3 episodes, 5 are wanted"):
        read_demonstrations(recorded, KEYS, PEG, num=5)


def test_task_without_demonstrator():
    with pytest.raises(ValueError, match=PEG):
        record.main(record.Args("PickCube-v1"))


def test_maniskill_replays_the_file_unchanged(recorded, tmp_path):
    for suffix in (".h5", ".json"):
        (tmp_path / "t").with_suffix(suffix).write_bytes(recorded.with_suffix(suffix).read_bytes())
    command = [
        sys.executable,
        "-m",
        "mani_skill.trajectory.replay_trajectory",
        "--traj-path",
        str(tmp_path / "t.h5"),
        "--count",
        "2",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert "2/2=100.00%" in done.stdout + done.stderr


@pytest.mark.parametrize(("seed", "num"), [(FIRST_EVALUATION_SEED, 1), (FIRST_EVALUATION_SEED - 2, 3), (-1, 1)])
def test_evaluation_seeds_are_refused(tmp_path, seed, num):
    with pytest.raises(InvalidArgumentError, match="from 100000 on are for evaluation"):
        run(tmp_path / "trajectory.h5", num, seed=seed)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["trajectory.hdf5", "trajectory"])
def test_a_file_whose_json_would_be_that_of_another_file_is_refused(recorded, tmp_path, name):
    for path in (recorded, recorded.with_suffix(".json")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    with pytest.raises(InvalidArgumentError, match=r"give one that ends in \.h5"):
        run(tmp_path / name, num=1, seed=7)
    assert validate(tmp_path / recorded.name) == []
    assert len(list(tmp_path.iterdir())) == 2


def test_a_folder_and_a_file_without_its_json_are_named(recorded, tmp_path):
    with pytest.raises(DemonstrationError, match=r"is a folder; give a trajectory file"):
        read_header(tmp_path)
    alone = tmp_path / recorded.name
    alone.write_bytes(recorded.read_bytes())
    with pytest.raises(DemonstrationError, match=r"trajectory\.json does not exist; copy both files"):
        read_header(alone)


def test_a_new_file_does_not_replace_a_result_by_its_json(tmp_path):
    result = tmp_path / "evaluation.json"
    result.write_text('{"schema": "manifeel-evaluation-3"}')
    with pytest.raises(DemonstrationError, match=r"evaluation.json is no recording's json; .* give another path"):
        run(tmp_path / "evaluation.h5", num=1)
    assert result.read_text() == '{"schema": "manifeel-evaluation-3"}'


@pytest.mark.parametrize(
    ("kwargs", "said"),
    [
        ('{"randomization": {"foo": 1}}', r"foo.* is unknown"),
        ('{"control_mode": "foo"}', r"foo.* is unknown"),
        ('{"max_episode_steps": "foo"}', r"cannot be made with .*max_episode_steps.*foo"),
    ],
)
def test_a_run_that_was_refused_does_not_stand_in_the_way_of_the_next(recorded, tmp_path, kwargs, said):
    path = tmp_path / "trajectory.h5"
    with pytest.raises(ManifeelError, match=said):
        record.main(record.Args(PEG, 1, out=path, obs_mode="tacff", env_kwargs=kwargs))
    assert [left.name for left in tmp_path.iterdir() if not left.name.endswith(".lock")] == []
    run(path, num=1)
    assert len(read_header(path)["episodes"]) == 1


def test_another_revision_of_the_task_does_not_mix_into_a_file(recorded, tmp_path):
    path = tmp_path / "trajectory.h5"
    path.write_bytes(recorded.read_bytes())
    header = json.loads(recorded.with_suffix(".json").read_text())
    assert header["revision"] == task_spec(PEG).revision
    path.with_suffix(".json").write_text(json.dumps(header | dict(revision=header["revision"] + 1)))
    with pytest.raises(DemonstrationError, match=f"revision={header['revision'] + 1}, this run asks for {header['revision']}"):
        run(path, num=4)


def test_the_header_names_the_module_that_registers_the_task(monkeypatch):
    env_class = type("TheirEnv", (), dict(__module__="their_package.tasks"))
    their = TaskSpec("Their-v1", env_class, "insertion", max_episode_steps=7, paper_demos=1)
    monkeypatch.setitem(registry._SPECS, "Their-v1", their)
    assert make_header("Their-v1", dict(obs_mode="none"))["env_info"]["env_id"] == "their_package.tasks:Their-v1"
    assert make_header(PEG, dict(obs_mode="none"))["env_info"]["env_id"] == f"manifeel_ms3:{PEG}"


def test_a_worker_that_is_killed_loses_no_finished_episode(recorded, tmp_path):
    path = tmp_path / "trajectory.h5"

    def kill_workers() -> None:
        for process in worker_processes(os.getpid()):
            with suppress(psutil.NoSuchProcess):  # an earlier test's process that has ended, but was not waited for
                process.kill()

    args = record.Args(PEG, 3, 1, 0, path, "tacff", cameras=(), tactile_sensors=("right",), env_kwargs=json.dumps(EASY))
    with pytest.raises(WorkFailedError, match="ended with exit code -9"):
        record.main(args, kill_workers)
    assert len(read_demonstrations(path, KEYS, PEG)) >= 1
    run(path, num=3)
    assert bytes_of(path) == bytes_of(recorded)
