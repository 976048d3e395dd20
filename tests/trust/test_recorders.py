"""Processes of `manifeel record` lose no finished episode, whenever and however often they are killed."""

import os
import random
import signal
import subprocess
import time
from pathlib import Path

import psutil
import pytest

from manifeel_ms3.demonstrations import dataset, render_observations
from manifeel_ms3.demonstrations.recording import STATES_FILE
from manifeel_ms3.errors import InUseError
from manifeel_ms3.ownership import owned
from manifeel_ms3.teleop.operator import Operator
from manifeel_ms3.teleop.session import Session
from tests.browser import wait_until
from tests.tasks_and_marks import PEG
from tests.trust.kills import PATIENCE, recorded, start_recording, worker_processes
from tests.trust.made_up_recordings import KWARGS, assert_same, seeds

two_and_hundred = pytest.mark.parametrize("count", [2, pytest.param(100, marks=pytest.mark.slow)])


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("undisturbed") / "t.h5"
    assert recorded(path, 3)[:2] == (0, 3)
    return path


def test_a01_a_kill_while_the_episodes_are_deleted_loses_nothing(undisturbed, tmp_path):
    path = tmp_path / "t.h5"
    assert recorded(path, 2, ["os.remove", "'seed_", 1])[0] == -signal.SIGKILL
    assert len(seeds(path)) == 2
    assert recorded(path, 3)[:2] == (0, 1)
    assert_same(path, undisturbed)


def test_a03_the_second_recorder_is_told_who_holds_the_file(undisturbed, tmp_path):
    path = tmp_path / "t.h5"
    first = start_recording(path, 3)
    assert first.stdout.readline() == "begin\n"
    wait_until(path.is_file, PATIENCE)
    code, episodes, errors = recorded(path, 3)
    assert (code, episodes) == (1, 0)
    assert f"t.h5 is in use by process {first.pid}" in errors
    assert "Traceback" not in errors
    assert first.communicate(timeout=PATIENCE)[0].count("episode") == 3
    assert_same(path, undisturbed)


def test_a03_all_that_writes_demonstrations_holds_its_file(make_env, undisturbed, tmp_path):
    with owned(tmp_path / "t.h5"), pytest.raises(InUseError):
        render_observations.main(render_observations.Args(undisturbed, tmp_path / "t.h5"))
    with owned(tmp_path / "t.h5"), pytest.raises(InUseError):
        Session(make_env(**KWARGS), PEG, KWARGS, tmp_path / "t.h5", 0, Operator(("x",)))
    with owned(tmp_path / "manifest.json"), pytest.raises(InUseError):
        dataset.main(dataset.Args(tmp_path, (PEG,), num=1, obs_mode="none"))
    with owned(tmp_path / PEG / STATES_FILE), pytest.raises(InUseError):
        dataset.main(dataset.Args(tmp_path, (PEG,), num=1, obs_mode="none"))
    Session(make_env(**KWARGS), PEG, KWARGS, tmp_path / "t.h5", 0, Operator(("x",))).finish()  # nothing was saved
    assert not list(tmp_path.glob("t.*"))


def test_b09_workers_end_with_a_killed_recorder(undisturbed, tmp_path, figure):
    path = tmp_path / "t.h5"
    process = start_recording(path, 3, workers=2)
    assert process.stdout.readline() == "begin\n"
    assert process.stdout.readline() == "episode\n"
    workers = worker_processes(process.pid)
    assert len(workers) == 2
    process.kill()
    begin = time.monotonic()
    process.wait()
    alive = psutil.wait_procs(workers, PATIENCE)[1]
    figure("time until workers have ended after kill -9 of the main process, s", time.monotonic() - begin, at_most=5)
    assert not alive
    assert recorded(path, 3)[0] == 0
    assert_same(path, undisturbed)


@two_and_hundred
def test_a01_record_is_killed_at_random_moments(undisturbed, tmp_path, count, figure):
    """Real processes, killed at random times; every second time the workers are left to themselves."""
    span, chance, kills, rounds = 6.0, random.Random(2), 0, 0
    while kills < count:
        path, held = tmp_path / f"killed{rounds}/t.h5", 0
        for _ in range(min(10, count)):
            process = start_recording(path, 3, workers=1 + rounds % 2)
            assert process.stdout.readline() == "begin\n"
            begin = time.monotonic()
            try:
                process.wait(chance.uniform(0, span))
                span = 0.5 * (span + time.monotonic() - begin)  # as long as this machine takes
                break
            except subprocess.TimeoutExpired:
                kills += 1
            process.kill() if kills % 2 else os.killpg(process.pid, signal.SIGKILL)
            held += process.communicate()[0].count("episode")
            if held or path.exists():
                assert len(seeds(path)) >= held
        assert recorded(path, 3)[0] == 0
        assert_same(path, undisturbed)
        rounds += 1
    figure("kills of `record` with the simulator", kills, at_least=count)
