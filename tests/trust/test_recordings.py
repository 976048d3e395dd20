"""Recordings lose no finished episode, whenever and however often a process is killed."""

import os
import random
import resource
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from manifeel_ms3.demonstrations import DemonstrationError
from manifeel_ms3.demonstrations.formats.maniskill_h5_writing import RecordedEpisode, episode_folder, write_episode
from manifeel_ms3.demonstrations.recording import open_recording
from manifeel_ms3.errors import ManifeelError
from manifeel_ms3.files import remove_folder
from manifeel_ms3.teleop.operator import Operator
from manifeel_ms3.teleop.session import Session
from tests.tasks_and_marks import PEG
from tests.trajectories import arrays_of
from tests.trust.kills import PATIENCE, forked
from tests.trust.made_up_recordings import HEADER, KWARGS, assert_same, made_up, record_made_up, seeds

ten_and_hundred = pytest.mark.parametrize("count", [10, pytest.param(100, marks=pytest.mark.slow)])


def kill_at_random(work, path: Path, count: int, held: set[int], chance: random.Random) -> int:
    """Kill `work` again and again, check the file after each kill, and return the number of kills.

    Every second kill comes before a random file event, and the others at a random time, such as inside a write of HDF5.

    Args:
        work: Called with a function that reports seeds.
        path: The trajectory file.
        count: Number of kills.
        held: Seeds that the file holds already.
        chance: Where the moments are drawn from.
    """
    kills, limit = 0, 12
    while kills < count:
        event, seconds = chance.randrange(limit), chance.uniform(0, limit / 1000)
        status, _, words = forked(work, kill_before=event) if kills % 2 else forked(work, kill_after=seconds)
        if status == 0:
            break
        assert status == -signal.SIGKILL
        kills += 1
        limit += 3  # later and later, so that it comes to an end
        held |= {int(word) for word in words}
        if held or path.exists():
            assert held <= set(seeds(path))
    return kills


@ten_and_hundred
def test_a01_recording_is_killed_at_random_moments(tmp_path, count, figure):
    record_made_up(tmp_path / "undisturbed/t.h5", 6)
    chance, kills, rounds = random.Random(0), 0, 0
    while kills < count:
        path = tmp_path / f"killed{rounds}/t.h5"
        held: set[int] = set()
        for num in (3, 6):  # a finished file, and further episodes to it
            kills += kill_at_random(partial(record_made_up, path, num), path, count, held, chance)
            record_made_up(path, num)
            assert len(seeds(path)) == num
        assert_same(path, tmp_path / "undisturbed/t.h5")
        rounds += 1
    figure("kills of a recording without a simulator", kills, at_least=count)


def prepare(path: Path) -> None:
    """Ten episodes, one of them rejected, before their consolidation into one file."""
    with open_recording(path, HEADER, range(20)) as recording:
        recording.begin()
        for seed in range(10):
            write_episode(recording.drafts, made_up(seed))
            recording.reject(seed) if seed == 1 else recording.accept(seed, made_up(seed).info)


def consolidate(path: Path) -> None:
    with open_recording(path, HEADER, range(20)) as recording:
        if not recording.is_complete:
            recording.finish()


@ten_and_hundred
def test_a01_consolidation_is_killed_at_random_times(tmp_path, count, figure):
    record_made_up(tmp_path / "undisturbed/t.h5", 9)
    prepare(tmp_path / "timed/t.h5")
    begin = time.monotonic()
    forked(lambda _: consolidate(tmp_path / "timed/t.h5"))
    duration, chance, kills, rounds = time.monotonic() - begin, random.Random(2), 0, 0
    while kills < count:
        path = tmp_path / f"killed{rounds}/t.h5"
        prepare(path)
        status = forked(lambda _, path=path: consolidate(path), kill_after=chance.uniform(0, duration))[0]
        assert status in (0, -signal.SIGKILL)
        kills += status != 0
        rounds += 1
        assert seeds(path) == [0, *range(2, 10)]
        consolidate(path)
        assert_same(path, tmp_path / "undisturbed/t.h5")
    figure("kills of a consolidation at random times", kills, at_least=count)


@pytest.mark.parametrize("step", [7, pytest.param(1, marks=pytest.mark.slow)])
def test_a01_consolidation_is_killed_before_every_file_event(tmp_path, step, figure):
    record_made_up(tmp_path / "undisturbed/t.h5", 9)
    prepare(tmp_path / "counted/t.h5")
    events = forked(lambda _: consolidate(tmp_path / "counted/t.h5"))[1]
    figure("file events of a consolidation, a process killed before each in turn", events, at_least=40)
    for moment in range(0, events, step):
        path = tmp_path / f"killed{moment}/t.h5"
        prepare(path)
        assert forked(lambda _, path=path: consolidate(path), moment)[0] == -signal.SIGKILL
        assert seeds(path) == [0, *range(2, 10)]
        consolidate(path)
        assert_same(path, tmp_path / "undisturbed/t.h5")


@pytest.mark.parametrize("step", [3, pytest.param(1, marks=pytest.mark.slow)])
def test_a09_a_kill_around_the_first_index_neither_blocks_nor_hides_the_settings(tmp_path, step):
    record_made_up(tmp_path / "undisturbed/t.h5", 1)
    other = HEADER | dict(env_info=dict(env_id="Another-v1"))
    events = forked(lambda _: record_made_up(tmp_path / "counted/t.h5", 1))[1]
    for moment in range(0, events, step):
        path = tmp_path / f"killed{moment}/t.h5"
        assert forked(lambda _, path=path: record_made_up(path, 1), moment)[0] == -signal.SIGKILL
        assert path.exists() or not episode_folder(path).exists()
        if path.exists():  # before an episode can be finished
            with pytest.raises(DemonstrationError, match="was recorded with env_info"), open_recording(path, other):
                pass
        record_made_up(path, 1)
        assert_same(path, tmp_path / "undisturbed/t.h5")


class Silent:
    """A screen that nobody looks at."""

    def show(self, obs, info): ...

    def set_message(self, text): ...


@ten_and_hundred
def test_a01_saves_of_teleoperation_are_killed_at_random_moments(make_env, tmp_path, count, figure):
    env = make_env(**KWARGS)

    def save(path: Path, say=lambda word: None) -> None:
        session = Session(env, PEG, KWARGS, path, 0, Operator(("x",)))
        for seed in range(session._seed, 4):
            assert session._save(Silent(), made_up(seed))
            say(str(seed))
        session.finish()

    save(tmp_path / "undisturbed/t.h5")
    chance, kills, rounds = random.Random(1), 0, 0
    while kills < count:
        path = tmp_path / f"killed{rounds}/t.h5"
        kills += kill_at_random(partial(save, path), path, count, set(), chance)
        save(path)
        assert_same(path, tmp_path / "undisturbed/t.h5")
        rounds += 1
    figure("kills of teleoperation's save", kills, at_least=count)


def test_b09_a_worker_that_outlives_its_session_cannot_write_into_the_next(tmp_path):
    with open_recording(tmp_path / "t.h5", HEADER) as dead:
        dead.begin()
    with open_recording(tmp_path / "t.h5", HEADER) as recording:
        recording.begin()
        write_episode(dead.drafts, made_up(0))
        write_episode(recording.drafts, made_up(1))
        recording.accept(1, made_up(1).info)
        write_episode(dead.drafts, made_up(1))
        recording.finish()
    assert seeds(tmp_path / "t.h5") == [1]
    assert not episode_folder(tmp_path / "t.h5").exists()


def test_b10_episodes_reach_the_disk_before_they_count(tmp_path):
    """Every file and folder is flushed before the renaming that makes it count, as Python's calls show."""
    trace = """
import os, sys
from pathlib import Path
flushed, renamed = set(), []
fsync, sync = os.fsync, lambda fd: (flushed.add(os.readlink(f"/proc/self/fd/{fd}")), fsync(fd))
os.fsync = sync
def see(event, given):
    if event == "os.rename":
        renamed.append((str(Path(given[0]).absolute()), str(Path(given[0]).absolute()) in flushed))
sys.addaudithook(see)
from tests.trust.made_up_recordings import record_made_up
record_made_up(Path(sys.argv[1]), 2)
record_made_up(Path(sys.argv[1]), 3)
for name, was_flushed in renamed:
    print(int(was_flushed or Path(name).suffix != ".partial"), name)
assert str(Path(sys.argv[1]).parent) in flushed
"""
    command = [sys.executable, "-c", trace, str(tmp_path / "t.h5")]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(lines) > 20
    assert any(line.endswith(".partial") for line in lines)
    assert [line for line in lines if not line.startswith("1")] == []


def test_a_full_disk_keeps_every_episode_and_can_be_gone_on_from(tmp_path):
    path = tmp_path / "t.h5"

    def full(say) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
        large = RecordedEpisode(
            2, dict(actions=np.random.default_rng(0).normal(size=(5000, 6))), dict(elapsed_steps=5000, success=True)
        )
        with open_recording(path, HEADER) as recording:
            recording.begin()
            write_episode(recording.drafts, made_up(0))
            recording.accept(0, made_up(0).info)
            with pytest.raises(ManifeelError, match="cannot be written"):
                write_episode(recording.drafts, large)
            say("refused")

    assert forked(full)[2] == ["refused"]
    assert seeds(path) == [0]
    with open_recording(path, HEADER) as recording:
        recording.begin()
        recording.finish()
    assert seeds(path) == [0]


@pytest.mark.parametrize("room", [1_000, 100_000, 200_000, 500_000])
def test_a_disk_that_is_full_in_the_middle_of_a_file_ends_no_process(tmp_path, room):
    """HDF5 frees memory twice where it cannot write the chunks of an array, and takes the process with it."""
    path = tmp_path / "t.h5"
    images = np.random.default_rng(0).integers(0, 255, (20, 64, 64, 3), dtype=np.uint8)  # 240 kB, which gzip does not shrink
    arrays = dict(actions=np.zeros((20, 6), np.float32), obs=dict(rgb=images))
    info = dict(elapsed_steps=20, success=True, peak_contact_force=1.0)

    def full(say) -> None:
        with open_recording(path, HEADER) as recording:
            recording.begin()
            for seed in range(3):
                write_episode(recording.drafts, RecordedEpisode(seed, arrays))
                recording.accept(seed, info)
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
            with pytest.raises(ManifeelError, match=r"t.h5 cannot be written \(.*File too large"):
                recording.finish()
            if room < images.nbytes:
                with pytest.raises(ManifeelError, match=r"seed_00000003.h5 cannot be written \(.*File too large"):
                    write_episode(recording.drafts, RecordedEpisode(3, arrays))
            say("refused")

    assert forked(full)[2] == ["refused"]
    assert seeds(path) == [0, 1, 2]
    assert np.array_equal(arrays_of(path)["traj_2/obs/rgb"], images)


def test_a_missing_folder_of_episodes_is_named(tmp_path):
    path = tmp_path / "t.h5"
    with open_recording(path, HEADER) as recording:
        recording.begin()
        write_episode(recording.drafts, made_up(0))
        recording.accept(0, made_up(0).info)
    path.unlink()
    with pytest.raises(DemonstrationError, match=r"whose file .*t.h5 is missing"), open_recording(path, HEADER):
        pass
    recording.begin()
    remove_folder(episode_folder(path))
    with pytest.raises(DemonstrationError, match=r"seed_00000000.h5, which does not exist"), open_recording(path, HEADER):
        pass


def test_a29_a_home_that_cannot_be_written_is_named(tmp_path):
    environment = os.environ | dict(HOME="/proc/none", XDG_CACHE_HOME="/proc/none/cache", MANIFEEL_CACHE_DIR="")
    command = [sys.executable, "-m", "manifeel_ms3.demonstrations.record", PEG, "-n", "1", "--out", str(tmp_path / "t.h5")]
    command += ["--obs-mode", "none", "--env-kwargs", '{"render_backend": "none"}']
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "MANIFEEL_CACHE_DIR" in done.stderr


ASCII = """
import sys
from pathlib import Path
from manifeel_ms3.files import read_json, write_json, write_text
from tests.trust.made_up_recordings import record_made_up, seeds

folder = Path(sys.argv[1])
write_text(folder / "page.html", "\\u00dcbung \\u2713")
write_json(folder / "file.json", dict(name="\\u00dcbung"))
assert read_json(folder / "file.json", {}, "a file") == dict(name="\\u00dcbung")
record_made_up(folder / "t.h5", 2)
record_made_up(folder / "t.h5", 3)
assert len(seeds(folder / "t.h5")) == 3
"""


@pytest.mark.parametrize("locale", ["C", "C.UTF-8"])
def test_a30_an_ascii_locale_writes_the_same(tmp_path, locale):
    environment = os.environ | dict(LC_ALL=locale, PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    folder = tmp_path / "Übung with space"
    done = subprocess.run(
        [sys.executable, "-c", ASCII, str(folder)], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (folder / "page.html").read_text(encoding="utf-8") == "Übung ✓"
