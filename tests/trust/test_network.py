"""Servers listen on this machine alone and refuse strangers: with real sockets, real processes, and what the kernel reports."""

import logging
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import psutil
import pytest

from tests.browser import wait_until
from tests.sample import states_sample
from tests.tasks_and_marks import PEG
from tests.trust.listening import LOOPBACK, free_port, hosts, hosts_by_port

REPOSITORY = Path(__file__).parents[2]
SAMPLE = states_sample(PEG)


# -------------------------------------------------------------------- the viewer


@pytest.fixture
def started():
    """Starts a process, and ends it after the test."""
    processes = []

    def start(command: list[str]) -> psutil.Process:
        processes.append(psutil.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        return processes[-1]

    yield start
    for process in processes:
        if process.is_running():
            for child in process.children(recursive=True):
                child.kill()
            process.kill()
        process.wait(30)


def test_every_address_on_which_a_process_listens_is_seen():
    with socket.create_server(("127.0.0.1", 0)) as first, socket.socket(socket.AF_INET6) as second:
        port = first.getsockname()[1]
        second.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        second.bind(("::", port))
        second.listen()
        assert hosts_by_port(psutil.Process())[port] == {"127.0.0.1", "::"}
        assert not hosts(psutil.Process()) <= LOOPBACK


def test_a20_the_viewer_in_a_browser_listens_on_loopback_only(started):
    pytest.importorskip("rerun")
    port = free_port()
    process = started([sys.executable, "-m", "manifeel_ms3.demonstrations.view", str(SAMPLE), "--web", "--port", str(port)])
    wait_until(lambda: port in hosts_by_port(process), 120)
    assert len(hosts_by_port(process)) == 2  # the page, and the data
    assert hosts(process) <= LOOPBACK
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
        assert b"rerun" in answer.read().lower()
    viewers = process.children(recursive=True)
    process.terminate()
    assert process.wait(30) == 130
    assert not any(viewer.is_running() for viewer in viewers)  # nothing goes on listening


def test_a20_the_viewer_in_a_window_listens_on_loopback_only(started, tmp_path):
    rerun = pytest.importorskip("rerun")
    from manifeel_ms3.demonstrations.view import viewer_command

    recording = rerun.RecordingStream("test")
    recording.log("value", rerun.Scalars([1.0]))
    recording.save(tmp_path / "value.rrd")
    recording.disconnect()
    process = started([*viewer_command(tmp_path / "value.rrd", None), "--headless"])  # the same viewer, without a screen
    wait_until(lambda: hosts_by_port(process) or not process.is_running(), 60)
    assert hosts(process) == {"127.0.0.1"}


# -------------------------------------------------------------------- the teleoperation page


@pytest.fixture
def page():
    """The page, and its server, on a free port."""
    pytest.importorskip("viser")
    from manifeel_ms3.teleop.operator import Operator
    from manifeel_ms3.teleop.page import Page

    page = Page(Operator(("x", "y", "z", "gripper")), "test", "localhost", free_port(), {})
    yield page
    page.stop()


def connect(page, path: str | None = None, host: str | None = None, origin: str | None = None):
    """A websocket to the page, with the path and host of its address and no origin, unless others are given."""
    import viser
    from websockets.sync.client import connect as client
    from websockets.typing import Origin, Subprotocol

    own = urlsplit(page.address)
    path, host = own.path if path is None else path, host or own.netloc
    link = socket.create_connection(("localhost", own.port))
    return client(
        f"ws://{host}{path}",
        sock=link,
        origin=Origin(origin) if origin else None,
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        proxy=None,
        max_size=None,
    )


def test_a21_the_page_listens_on_loopback_only(page):
    from manifeel_ms3.teleop.__main__ import Args

    port = urlsplit(page.address).port
    assert port is not None
    assert hosts_by_port(psutil.Process())[port] <= LOOPBACK
    assert Args.host == "localhost"  # unless it is told otherwise


def test_the_example_of_a_policys_server_listens_on_loopback_only(started):
    port = free_port()
    process = started([sys.executable, str(REPOSITORY / "examples/policy_server.py"), "--port", str(port)])
    wait_until(lambda: port in hosts_by_port(process), 60)
    assert hosts(process) <= LOOPBACK


def test_a21_the_page_takes_who_has_its_address(page):
    own = urlsplit(page.address)
    for origin in (None, f"http://{own.netloc}"):
        with closing(connect(page, origin=origin)) as link:
            assert link.recv(timeout=30)
    forwarded = "localhost:9999"  # by `ssh -L 9999:localhost:8080`
    with closing(connect(page, host=forwarded, origin=f"http://{forwarded}")) as link:
        assert link.recv(timeout=30)
    with urllib.request.urlopen(page.address) as answer:
        assert b"Viser" in answer.read()


@pytest.mark.parametrize(
    "lie",
    [
        dict(path="/"),
        dict(path="/guess"),
        dict(path=""),
        dict(path="/?token=guess"),
        dict(origin="https://evil.example"),
        dict(origin="http://localhost:1"),  # another server of this machine
        dict(origin="null"),
        dict(host="attacker.example"),
        dict(host="attacker.example", origin="http://attacker.example"),
        dict(host="localhost.attacker.example"),
        dict(host="127.0.0.1.attacker.example:8080"),
    ],
    ids=str,
)
def test_a21_the_page_refuses_everybody_else(page, lie):
    from websockets.exceptions import InvalidStatus

    with pytest.raises(InvalidStatus) as refused:
        connect(page, **lie)
    assert refused.value.response.status_code == 403
    token = urlsplit(page.address).path.strip("/")
    assert token.encode() not in refused.value.response.body


def test_a21_the_files_of_the_page_need_the_token_too(page):
    own = urlsplit(page.address)
    for path in ("/", "/index.html", "/guess/", "/favicon.ico"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(f"http://{own.netloc}{path}")


def test_a21_nobody_can_ask_for_a_public_tunnel(page, monkeypatch, caplog):
    import msgspec
    import viser._viser as viser_server

    made = []
    monkeypatch.setattr(viser_server, "ViserTunnel", lambda *args: made.append(args))  # nothing shall leave the machine
    with caplog.at_level(logging.WARNING), closing(connect(page)) as link:
        link.recv(timeout=30)
        for kind in ("ShareUrlRequest", "ShareUrlDisconnect"):
            link.send(msgspec.msgpack.encode({"type": kind}))
        wait_until(lambda: made or "public address" in caplog.text, 30)
        time.sleep(0.2)
    assert made == []


def test_a21_each_start_has_another_token(page):
    from manifeel_ms3.teleop.operator import Operator
    from manifeel_ms3.teleop.page import Page

    other = Page(Operator(("x", "gripper")), "test", "localhost", free_port(), {})
    try:
        assert urlsplit(other.address).path != urlsplit(page.address).path
        assert len(urlsplit(page.address).path) > 20
    finally:
        other.stop()


def test_a21_a_page_for_other_machines_asks_for_the_token_too():
    pytest.importorskip("viser")
    from websockets.exceptions import InvalidStatus

    from manifeel_ms3.teleop.operator import Operator
    from manifeel_ms3.teleop.page import Page

    page = Page(Operator(("x", "gripper")), "test", "0.0.0.0", free_port(), {})
    own = urlsplit(page.address)
    try:
        assert own.hostname == socket.gethostname().lower()
        for host in (own.netloc, f"192.0.2.7:{own.port}"):
            with closing(connect(page, host=host)) as link:
                assert link.recv(timeout=30)
        for lie in (dict(path="/"), dict(host="attacker.example"), dict(origin="https://evil.example")):
            with pytest.raises(InvalidStatus, match="403"):
                connect(page, **lie)
    finally:
        page.stop()


# -------------------------------------------------------------------- the doctor, and the cache


def test_a13_the_doctor_imports_nothing_from_the_current_folder(monkeypatch, tmp_path):
    from manifeel_ms3 import doctor

    for name in ("torch", "gymnasium", "json"):
        (tmp_path / f"{name}.py").write_text(f"import pathlib; pathlib.Path({str(tmp_path / 'ran')!r}).write_text('{name}')")
    monkeypatch.chdir(tmp_path)
    ran = doctor._run("import json, torch, gymnasium; print(torch.__version__)")
    assert ran.worked, ran.reason
    assert not (tmp_path / "ran").exists()


@pytest.mark.skipif(sys.version_info < (3, 11), reason="PYTHONSAFEPATH is of Python 3.11")
def test_a13_worker_processes_import_nothing_from_the_current_folder(tmp_path):
    """Not even while they start, before they know where their modules are."""
    for name in ("pickle", "socket", "multiprocessing/__init__"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.py").write_text(f"import pathlib; pathlib.Path({str(tmp_path / 'ran')!r}).write_text('{name}')")
    (tmp_path / "elsewhere").mkdir()
    script = tmp_path / "elsewhere/script.py"
    script.write_text(
        "import operator\n"
        "from manifeel_ms3.evaluation.policy import PolicySource\n"
        "from manifeel_ms3.evaluation.policy_process import PolicyProcess, SharedPolicy\n"
        "from manifeel_ms3.workers import WorkerPool\n"
        "if __name__ == '__main__':\n"
        "    with WorkerPool(1, int) as pool:\n"
        "        pool.submit(operator.add, 3)\n"
        "        print([finished.result() for finished in pool.as_finished()])\n"
        "    source = PolicySource(policy='tests.evaluation.policies:StandStill')\n"
        "    with PolicyProcess(source, 60.0) as process:\n"
        "        SharedPolicy(process.address, source.make).reset()\n"
    )
    environment = os.environ | dict(PYTHONPATH=str(REPOSITORY))
    done = subprocess.run([sys.executable, script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert not (tmp_path / "ran").exists(), (tmp_path / "ran").read_text()
    assert (done.returncode, done.stdout) == (0, "[3]\n"), done.stderr


CALLS = {
    "robot": "from manifeel_ms3.agents.panda_gelsight_urdf import panda_gelsight_urdf; panda_gelsight_urdf()",
    "part": "import trimesh; from manifeel_ms3.geometry.part import _cached_obj; _cached_obj([trimesh.creation.box()])",
}


@pytest.mark.parametrize("call", CALLS)
def test_a29_a_home_that_cannot_be_written_is_named_with_its_remedy(call, tmp_path):
    """/proc takes no new folder, not even of root."""
    environment = {name: value for name, value in os.environ.items() if name not in ("MANIFEEL_CACHE_DIR", "XDG_CACHE_HOME")}
    program = (
        "import sys; from types import SimpleNamespace; from manifeel_ms3.command_line import run\n"
        "def main(_):\n"
        f"    {CALLS[call]}\n"
        "sys.exit(run(main, None))"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, env=environment | {"HOME": "/proc/none"}, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "/proc/none/.cache/manifeel_ms3" in done.stderr
    assert "MANIFEEL_CACHE_DIR" in done.stderr
    assert "Traceback" not in done.stderr
    kept = environment | {"HOME": "/proc/none", "MANIFEEL_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(command, env=kept, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
