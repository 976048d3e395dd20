"""A person's commands become episodes: on the real simulator, without a page."""

import json
import threading
import time
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import tyro

from manifeel_ms3.demonstrations.formats.maniskill_h5 import DemonstrationError, open_trajectories, read_header
from manifeel_ms3.demonstrations.replay import replay
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.tasks.registry import FIRST_EVALUATION_SEED
from manifeel_ms3.teleop import __main__ as teleop
from manifeel_ms3.teleop import session as module
from manifeel_ms3.teleop.operator import HOLD, EpisodeCommand, Mode, Operator, steerable_axes
from manifeel_ms3.teleop.session import Session
from tests.browser import wait_until
from tests.tasks_and_marks import PEG
from tests.teleop.axes import AXES
from tests.trust.made_up_recordings import made_up

KWARGS = dict(obs_mode="tacff", render_backend="none", sim_backend="physx_cpu", cameras=[], tactile_sensors=["right"])


def test_the_seeds_of_evaluations_are_not_recorded(make_env, tmp_path):
    """A file may end at the last seed for demonstrations."""
    env, last = make_env(**KWARGS), FIRST_EVALUATION_SEED - 1
    session = Session(env, PEG, KWARGS, tmp_path / "t.h5", last, Operator(("x",)))
    assert session._save(Notes(), replace(made_up(0), seed=last))
    session.finish()
    session = Session(env, PEG, KWARGS, tmp_path / "t.h5", 0, Operator(("x",)))
    with pytest.raises(InvalidArgumentError, match=f"the next episode would have the seed {FIRST_EVALUATION_SEED}"):
        session.run(Notes())
    session.finish()


class Notes:
    """A screen that keeps what a person would have seen."""

    def __init__(self):
        self.steps, self.lines, self.info = 0, [], {}

    def show(self, obs, info):
        self.info = info
        assert obs["sensor_data"]["tactile_right"]["force_field"].shape == (1, 10, 14, 3)
        self.steps += 1

    def set_message(self, text):
        self.lines.append(text)

    def has_line(self, word: str) -> bool:
        return any(word in line for line in self.lines)


class Desk:
    """A session that runs in a thread, and what belongs to it."""

    def __init__(self, out: Path, task: str = PEG, **kwargs):
        self.kwargs = KWARGS | kwargs
        self.env = gym.make(task, **self.kwargs)
        self.operator, self.screen = Operator(steerable_axes(self.env.unwrapped.control_mode)), Notes()
        self.session = Session(self.env, task, self.kwargs, out, 0, self.operator)
        self.thread = threading.Thread(target=self.session.run, args=(self.screen,), daemon=True)
        self.thread.start()
        wait_until(lambda: self.screen.steps > 0)

    def move(self, axis: str, direction: float, steps: int = 3) -> None:
        """Hold a key for so many steps."""
        self.operator.start()
        until = self.screen.steps + steps
        while self.screen.steps < until:
            self.operator.push(axis, direction)
            time.sleep(0.02)

    def command(self, command: EpisodeCommand, word: str) -> None:
        """Give a command, and wait for a message that holds a word."""
        self.screen.lines.clear()
        self.operator.command(command)
        wait_until(lambda: self.screen.has_line(word))

    def close(self) -> None:
        self.operator.close()
        self.thread.join()
        self.session.finish()
        self.env.close()


@pytest.fixture
def desk(tmp_path):
    desks = []

    def make(**kwargs) -> Desk:
        desks.append(Desk(tmp_path / "human.h5", **kwargs))
        return desks[-1]

    yield make
    for each in desks:
        if each.thread.is_alive():
            each.close()


def test_episodes_are_saved_discarded_and_tried_again(desk, tmp_path):
    first = desk()
    first.move("z", -1.0)
    first.command(EpisodeCommand.SAVE, "seed 1, 1 saved")
    first.move("x", 1.0)
    first.command(EpisodeCommand.RETRY, "seed 1, 1 saved")
    first.move("y", 1.0)
    first.command(EpisodeCommand.DISCARD, "seed 2, 1 saved")
    first.command(EpisodeCommand.SAVE, "seed 2, 1 saved")  # nothing was recorded
    first.command(EpisodeCommand.DISCARD, "seed 3, 1 saved")
    first.close()

    second = desk()  # another day: what is there stays
    second.move("yaw", -1.0)
    second.command(EpisodeCommand.STOP, "save or discard")
    second.command(EpisodeCommand.SAVE, "2 saved")
    second.close()

    path = tmp_path / "human.h5"
    header = read_header(path)
    assert header["source_type"] == "human"
    assert [episode["episode_seed"] for episode in header["episodes"]] == [0, 1]
    with open_trajectories(path) as file:
        down, turned = (np.asarray(file[f"traj_{k}/actions"]) for k in range(2))
    assert (down[:, 2] < 0).sum() >= 2  # a key pressed just before a step, or just after
    assert np.all(down[:, [0, 1, 3, 4, 5]] == 0)
    assert (turned[:, 5] < 0).sum() >= 2
    assert [one.deviation for one in replay(path)] == [0.0, 0.0]


def test_a_full_disk_loses_nothing(desk, tmp_path, monkeypatch):
    full = desk()
    full.move("z", 1.0)
    write = module.write_episode

    def no_room(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "write_episode", no_room)
    full.command(EpisodeCommand.SAVE, "No space left on device")
    time.sleep(3 * module.PATIENCE)
    assert "No space left on device" in full.screen.lines[-1]  # until the person has done something
    monkeypatch.setattr(module, "write_episode", write)
    full.command(EpisodeCommand.SAVE, "1 saved")
    full.close()
    assert len(read_header(tmp_path / "human.h5")["episodes"]) == 1


def test_nothing_moves_before_start_nor_while_paused(desk):
    still = desk()
    still.operator.push("z", -1.0)
    time.sleep(1.0)
    assert still.screen.steps == 1  # what the reset shows
    still.move("z", -1.0)
    still.operator.pause()
    time.sleep(0.5)
    steps = still.screen.steps
    time.sleep(1.0)
    assert still.screen.steps == steps


@pytest.mark.parametrize("task", ["ManiFeel-NutBoltAssembly-v1", "ManiFeel-BulbInstallation-v1"])
def test_the_hand_keeps_the_part_that_it_starts_with_until_the_person_opens_it(desk, task):
    idle = desk(task=task)
    idle.operator.start()
    wait_until(lambda: idle.screen.steps > 20)
    assert not idle.screen.info["fail"].any()
    idle.operator.toggle_gripper()
    wait_until(lambda: idle.screen.info["fail"].any())


def test_a_file_of_another_task_stays(desk, tmp_path):
    first = desk()
    first.move("z", -1.0)
    first.command(EpisodeCommand.SAVE, "1 saved")
    first.close()
    before = (tmp_path / "human.h5").read_bytes()
    other = KWARGS | dict(fit="paper")
    env = gym.make(PEG, **other)
    with pytest.raises(DemonstrationError, match="fit"):
        Session(env, PEG, other, tmp_path / "human.h5", 0, Operator(AXES))
    env.close()
    assert (tmp_path / "human.h5").read_bytes() == before
    assert json.loads((tmp_path / "human.json").read_text())["source_type"] == "human"


# -------------------------------------------------------------------- the operator


def test_a_push_lasts_a_moment_and_the_gripper_stays():
    now = [0.0]
    operator = Operator(AXES, clock=lambda: now[0])
    operator.speed = 0.4
    operator.push("y", -1.0)
    operator.push("roll", 5.0)
    operator.toggle_gripper()
    assert operator.action() == pytest.approx([0, -0.4, 0, 1.0, 0, 0, -1.0])  # no action leaves [-1, 1]
    now[0] = HOLD
    assert operator.action() == pytest.approx([0, 0, 0, 0, 0, 0, -1.0])


def test_the_gripper_closes_again_with_the_command_that_held_the_part():
    operator, commands = Operator(AXES), []
    for command, holds_part in ((-0.4, True), (0.6, False)):
        operator.take_over_gripper(command, holds_part)
        for _ in range(3):
            commands.append(float(operator.action()[-1]))
            operator.toggle_gripper()
    assert commands == pytest.approx([-0.4, 1.0, -0.4, 0.6, -1.0, 1.0])


def test_modes_follow_each_other():
    operator = Operator(AXES)
    operator.pause()
    assert operator.mode is Mode.READY  # nothing to pause
    operator.start()
    operator.pause()
    operator.start()
    assert operator.mode is Mode.RUNNING
    operator.close()
    operator.begin()
    operator.start()
    assert operator.mode is Mode.CLOSED


def test_a_control_mode_that_cannot_be_steered_is_refused():
    with pytest.raises(InvalidArgumentError, match=r"control_mode='pd_joint_pos' .* choose from \['pd_ee_delta_pose'"):
        steerable_axes("pd_joint_pos")


def test_an_axis_that_is_locked_cannot_be_pushed():
    operator = Operator(steerable_axes("pd_ee_delta_pose_fixed_roll_pitch"))
    assert operator.axes == ("x", "y", "z", None, None, "yaw", "gripper")
    for axis in ("x", "roll", "yaw"):
        operator.push(axis, 1.0)
    assert operator.action().tolist() == [0.5, 0.0, 0.0, 0.0, 0.0, 0.5, 1.0]


@pytest.mark.parametrize("seed", [-1, 100_000])
def test_seeds_that_are_not_for_demonstrations_are_refused(seed, make_env, tmp_path):
    env = make_env(**KWARGS)
    operator = Operator(steerable_axes(env.unwrapped.control_mode))
    with pytest.raises(InvalidArgumentError, match=f"--seed {seed}: demonstrations have the seeds 0 to 99999"):
        Session(env, PEG, KWARGS, tmp_path / "trajectory.h5", seed, operator)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("flags", [["none"], ["state"], ["tacff", "--tactile-sensors"]], ids=" ".join)
def test_a_session_without_images_is_refused_before_the_page_opens(flags, tmp_path):
    pytest.importorskip("viser")
    given = [PEG, "--out", str(tmp_path / "x.h5"), "--env-kwargs", '{"render_backend": "none"}', "--obs-mode", *flags]
    with pytest.raises(InvalidArgumentError, match=f"nothing to show with --obs-mode {flags[0]} .*; add rgb, tacrgb or tacff"):
        teleop.main(tyro.cli(teleop.Args, args=given))
    assert list(tmp_path.iterdir()) == []
