"""The page, in a real browser: it loads and steers, another one watches, and a page that is lost stops the robot."""

import signal
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from manifeel_ms3.demonstrations.formats.maniskill_h5 import open_trajectories
from manifeel_ms3.demonstrations.replay import replay
from tests.browser import Browser, browser_program, wait_until
from tests.tasks_and_marks import PEG, needs_renderer
from tests.trust.listening import free_port

pytest.importorskip("viser")
pytestmark = [needs_renderer, pytest.mark.skipif(browser_program() is None, reason="no browser on this machine")]
SPACE, ENTER, DOWN, AHEAD = (" ", "Space", 32), ("Enter", "Enter", 13), ("f", "KeyF", 70), ("w", "KeyW", 87)


@pytest.fixture
def address(tmp_path):
    """Address of a page that `manifeel teleop` serves, with the token, as the command prints it."""
    port = free_port()
    files = ["--out", str(tmp_path / "human.h5"), "--port", str(port)]
    slow_machine = ["--env-kwargs", '{"max_episode_steps": 3000}']  # the task's own limit ends after 24 s
    command = [sys.executable, "-m", "manifeel_ms3.teleop", PEG, *files, *slow_machine]
    heeding = ["env", "--default-signal=INT", *command]  # a background job's processes ignore SIGINT by default
    process = subprocess.Popen(heeding, stderr=subprocess.PIPE, text=True)
    try:
        address = next(line for line in process.stderr if "shows the robot" in line).split()[0]
        assert address.startswith(f"http://localhost:{port}/")
        yield address
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[1]
        assert process.returncode == 0, said
        assert "what was saved" in said
    finally:
        process.kill()


def listening_addresses(port: int) -> set[str]:
    """Hosts on which something listens on a port, as the kernel lists them, in hexadecimal."""
    lines = [line.split() for table in ("tcp", "tcp6") for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]]
    local = [line[1].split(":") for line in lines if line[3] == "0A"]
    return {host for host, number in local if int(number, 16) == port}


def test_a_key_that_is_held_down_counts_once():
    page = pytest.importorskip("manifeel_ms3.teleop.page")
    now, pressed = [0.0], []
    key = page.once_a_press(lambda: pressed.append(now[0]), clock=lambda: now[0])
    for moment in (0.0, 0.6, 0.63, 0.66, 2.0):  # a press, its repeats after the usual delay, and another press
        now[0] = moment
        key()
    assert pressed == [0.0, 2.0]


def test_a_person_records_an_episode(address, tmp_path):
    path, port = tmp_path / "human.h5", urlsplit(address).port
    wait_until(lambda: listening_addresses(port), 120)
    assert listening_addresses(port) <= {"0100007F", "00000000000000000000000001000000"}  # localhost, of IPv4 and IPv6

    with Browser(address, tmp_path / "first") as first:
        wait_until(lambda: "you steer" in first.text and "ready" in first.text)
        with Browser(address, tmp_path / "second") as second:
            wait_until(lambda: "you watch" in second.text and "discard" in second.text)
            first.press(*SPACE)
            wait_until(lambda: "recording" in second.text, page=second)
            first.press(*DOWN, times=20)  # held for a second, which is few steps on a slow machine
            second.press(*AHEAD, times=5)  # ignored
            second.press(*SPACE)
            wait_until(lambda: "recording" in second.text, page=second)
            first.close()
            wait_until(lambda: "paused" in second.text, page=second)
            second.press(*SPACE)  # ignored, too, before this page has taken over
            second.click("take over")
            wait_until(lambda: "you steer" in second.text, page=second)
            assert "paused" in second.text
            second.press(*SPACE)
            wait_until(lambda: "recording" in second.text, page=second)
            second.press(*DOWN, times=10)
            second.press(*ENTER)
            wait_until(lambda: "1 saved" in second.text, page=second)

    with open_trajectories(path) as file:
        actions = np.asarray(file["traj_0/actions"])
        height = np.asarray(file["traj_0/obs/extra/tcp_pose"])[:, 2]
        assert file["traj_0/obs/sensor_data/tactile_right/rgb"].shape[0] == len(actions) + 1
    assert (actions[:, 2] < 0).sum() >= 5
    assert np.all(actions[:, :2] == 0)
    assert height[-1] < height[0] - 0.005  # the arm went where the key said
    assert [one.deviation for one in replay(path)] == [0.0]
