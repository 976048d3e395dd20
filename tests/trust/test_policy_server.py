"""A policy's server: its episodes stay apart, its absence does not count as a failed episode, and its answers do no harm."""

import io
import json
import os
import runpy
import socket
import struct
import subprocess
import sys
import threading
import time
import zipfile
from base64 import b64encode
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from manifeel_ms3.errors import InvalidArgumentError, ServerError
from manifeel_ms3.evaluation.evaluate import Args, main
from manifeel_ms3.evaluation.policy import PolicyUnavailableError
from manifeel_ms3.evaluation.remote_policy import RemotePolicy
from manifeel_ms3.evaluation.result import read_result
from tests.tasks_and_marks import PEG

REPOSITORY = Path(__file__).parents[2]
EXAMPLE = REPOSITORY / "examples/policy_server.py"
OBSERVATION = dict(extra=dict(tcp_pose=np.zeros((1, 7))))
NOT_THERE = "http://127.0.0.1:9"


@contextmanager
def served(handler: type[BaseHTTPRequestHandler]):
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


def example(**changes) -> SimpleNamespace:
    """The example's names, some of them replaced; its functions use the replaced ones."""
    names = runpy.run_path(str(EXAMPLE))
    handler = names["Handler"]
    handler.reset.__globals__.update(names | changes)
    return SimpleNamespace(**names)


class CountsSteps:
    """A policy whose action is the number of steps of its episode."""

    def __init__(self):
        self.steps = 0

    def act(self, obs):
        self.steps += 1
        return np.full(6, self.steps / 100)


def step_of(policy: RemotePolicy) -> int:
    return round(100 * policy.act(OBSERVATION)[0])


def args_of(address: str, out: Path, **changes) -> Args:
    task = json.dumps(dict(render_backend="none", max_episode_steps=3))
    return Args(policy=address, env_id=PEG, obs_mode="tacff", cameras=(), episodes=2, env_kwargs=task, out=out, **changes)


# ------------------------------------------------------------------------------- episodes


def test_a08_workers_that_share_a_server_do_not_mix_its_state():
    with served(example(MyPolicy=CountsSteps).Handler) as address:
        first, second = RemotePolicy(address), RemotePolicy(address)
        first.reset()
        assert [step_of(first) for _ in range(6)] == [1, 2, 3, 4, 5, 6]
        second.reset()
        assert [step_of(second), step_of(first), step_of(second)] == [1, 7, 2]
        first.reset()
        assert [step_of(first), step_of(second)] == [1, 3]


def test_a08_the_example_forgets_the_oldest_episodes_and_says_so():
    with served(example(MyPolicy=CountsSteps, MAX_EPISODES=2).Handler) as address:
        old, used, new = (RemotePolicy(address) for _ in range(3))
        old.reset()
        used.reset()
        assert step_of(old) == 1  # now `used` is the oldest
        new.reset()
        assert [step_of(old), step_of(new)] == [2, 1]
        with pytest.raises(PolicyUnavailableError, match="410: this episode is unknown or was forgotten"):
            used.act(OBSERVATION)


def test_the_example_gets_the_vector_of_the_mode_state_by_its_name():
    class Repeats:
        def act(self, obs):
            assert list(obs) == ["state"]
            return obs["state"]

    with served(example(MyPolicy=Repeats).Handler) as address:
        policy = RemotePolicy(address)
        policy.reset()
        assert policy.act(torch.arange(6.0)[None]).tolist() == [0, 1, 2, 3, 4, 5]


def test_the_example_serves_no_policy_at_another_path():
    with (
        served(example().Handler) as address,
        pytest.raises(PolicyUnavailableError, match="404: /act/reset is neither /reset nor /act"),
    ):
        RemotePolicy(f"{address}/act").reset()


def test_a08_a_server_that_does_not_know_episodes_is_refused(tmp_path):
    class Old(BaseHTTPRequestHandler):
        def do_POST(self):
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_):
            pass

    with served(Old) as address, pytest.raises(PolicyUnavailableError, match="does not repeat the header X-Episode"):
        main(args_of(address, tmp_path / "evaluation.json"))
    assert not list(tmp_path.glob("evaluation*"))


def test_the_example_says_nothing_about_a_client_that_has_gone(capfd):
    asked, gone = threading.Event(), threading.Event()
    threads = []

    class Slow:
        def act(self, obs):
            threads.append(threading.current_thread())
            asked.set()
            assert gone.wait(60)
            return np.zeros(6)

    with served(example(MyPolicy=Slow).Handler) as address:
        policy = RemotePolicy(address)
        policy.reset()
        body = io.BytesIO()
        np.savez(body, state=np.zeros(6))
        head = f"POST /act HTTP/1.1\r\nX-Episode: {policy._episode}\r\nContent-Length: {body.tell()}\r\n\r\n"
        with socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2]))) as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # what it closes is reset at once
            client.sendall(head.encode() + body.getvalue())
            assert asked.wait(60)
        gone.set()
        threads[0].join(60)
    assert "Traceback" not in capfd.readouterr().err


# ------------------------------------------------------------------------------- absence


def test_b04_a_server_that_cannot_be_reached_ends_the_evaluation(tmp_path):
    out = tmp_path / "evaluation.json"
    out.write_text("the result of before")
    with pytest.raises(PolicyUnavailableError, match=r"127.0.0.1:9 cannot be reached \(.*refused.*start the server first"):
        main(args_of(NOT_THERE, out))
    assert out.read_text() == "the result of before"
    assert list(tmp_path.glob("evaluation*")) == [out]


def test_b04_a_server_that_drops_packets_ends_the_evaluation(tmp_path):
    """A full queue of connections that nobody accepts: a further connection is never answered."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen(0)
        waiting = [socket.socket() for _ in range(4)]
        for one in waiting:
            one.setblocking(False)
            one.connect_ex(server.getsockname())
        address = f"http://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(PolicyUnavailableError, match=r"cannot be reached \(timed out\)"):
            main(args_of(address, tmp_path / "evaluation.json", step_timeout=4.0))
        for one in waiting:
            one.close()
    assert not list(tmp_path.glob("evaluation*"))


def test_b04_an_evaluation_goes_on_when_its_server_is_back(tmp_path):
    whole = example().Handler

    resets = []

    class DiesInSecondEpisode(whole):
        def reset(self):
            resets.append(self.headers["X-Episode"])
            if len(resets) == 2:
                self.connection.shutdown(socket.SHUT_RDWR)
            return super().reset()

    with served(DiesInSecondEpisode) as address:
        args = args_of(address, tmp_path / "evaluation.json")
        with pytest.raises(PolicyUnavailableError, match="cannot be reached"):
            main(args)
        journal = tmp_path / "evaluation.episodes.jsonl"
        kept = json.loads(journal.read_text().splitlines()[1])
        episodes = read_result(main(args))["episodes"]
    assert episodes[0] == kept
    assert [episode["error"] for episode in episodes] == [None, None]


@pytest.mark.parametrize("status", [302, 401, 404, 405, 410, 501, 502, 503])
def test_b04_what_is_not_the_policys_fault_ends_the_evaluation(status):
    class Says(BaseHTTPRequestHandler):
        def do_POST(self):
            self.send_response(status)
            self.send_header("Location", NOT_THERE)
            self.end_headers()

        def log_message(self, *_):
            pass

    with served(Says) as address, pytest.raises(PolicyUnavailableError, match=f"answers reset with {status}"):
        RemotePolicy(address).reset()


@pytest.mark.parametrize("address", ["http://", "http://host:port", "http://host:99999", "http://host?token=x", "http://[::1"])
def test_what_is_no_address_is_refused(address):
    with pytest.raises(InvalidArgumentError, match="give one like http://localhost:8000"):
        RemotePolicy(address)


@pytest.mark.parametrize("timeout", [0, -1, float("nan"), float("inf"), "10", None])
def test_a_time_limit_that_is_none_is_refused(timeout):
    with pytest.raises(InvalidArgumentError, match=r"timeout=.* must be a number of seconds above 0"):
        RemotePolicy(NOT_THERE, timeout)


# ------------------------------------------------------------------------------- hostile answers


def npy(header: str, data: bytes = b"", version: int = 1) -> bytes:
    length = len(header).to_bytes(2 if version == 1 else 4, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + length + header.encode() + data


def npz(pieces, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive, archive.open("action.npy", "w") as entry:
        for piece in pieces:
            entry.write(piece)
    return file.getvalue()


def header(shape: str, descr: str = "'<f8'") -> str:
    return f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n"


class RunsCode:
    def __reduce__(self):
        return os.system, ("touch /tmp/code_from_a_server_ran",)


def pickled() -> bytes:
    file = io.BytesIO()
    np.savez(file, action=np.array([RunsCode()], dtype=object))
    return file.getvalue()


MEGABYTE = bytes(2**20)
LONG = 2**29
HEAD = b"HTTP/1.1 200 OK\r\nX-Episode: %s\r\n"
HOSTILE_CONTENTS = {
    "zip bomb": lambda: npz([npy(header(f"({LONG // 8},)")), *[MEGABYTE] * 512]),
    "bzip2 bomb": lambda: npz([npy(header(f"({LONG // 8},)")), *[MEGABYTE] * 512], zipfile.ZIP_BZIP2),
    "header bomb": lambda: npz([npy("", version=2)[:8] + LONG.to_bytes(4, "little"), *[b" " * 2**20] * 512]),
    "huge shape": lambda: npz([npy(header(f"({2**31},)"))], zipfile.ZIP_STORED),
    "huge shape of bytes": lambda: npz([npy(header(f"({2**36},)", "'|u1'"))], zipfile.ZIP_STORED),
    "negative shape": lambda: npz([npy(header("(-1,)"), bytes(64))]),
    "no data": lambda: npz([npy(header("(7,)"))]),
    "deep header": lambda: npz([npy("(" * 250)]),
    "words": lambda: npz([npy(header("(1,)", "'<U4'"), bytes(16))]),
    "records": lambda: npz([npy(header("(1,)", "[('a', '<f8')]"), bytes(8))]),
    "pickle": pickled,
    "no zip": lambda: b"left",
    "nothing": lambda: b"",
}


def answer_endlessly(connection: socket.socket, head: bytes) -> None:
    connection.sendall(head)
    while True:
        connection.sendall(MEGABYTE)


def answer(connection: socket.socket, attack: str, head: bytes) -> None:
    if attack == "endless":
        answer_endlessly(connection, head + b"\r\n")
    elif attack == "endless, with a length":
        answer_endlessly(connection, head + b"Content-Length: 1000000000000\r\n\r\n")
    elif attack == "endless error":
        answer_endlessly(connection, b"HTTP/1.1 500 No\r\n\r\n")
    elif attack == "endless chunk":
        answer_endlessly(connection, head + b"Transfer-Encoding: chunked\r\n\r\nffffffffff\r\n")
    elif attack == "endless headers":
        while True:
            connection.sendall(b"HTTP/1.1 200 OK\r\n" + b"X: " + b"x" * 60_000 + b"\r\n")
    else:
        connection.sendall(head + b"\r\n" + HOSTILE_CONTENTS[attack]())


@contextmanager
def hostile_server():
    """Address of a server whose answer depends on the path."""

    def serve(connection: socket.socket) -> None:
        request = b""
        with connection:
            try:
                while b"\r\n\r\n" not in request:
                    request += connection.recv(4096)
                name = request.split(b" ")[1].decode().split("/")[1].replace("_", " ")
                episode = request.lower().split(b"x-episode: ")[1].split(b"\r\n")[0]
                answer(connection, name, HEAD % episode)
            except OSError:
                pass  # the client has had enough

    def accept() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=serve, args=(connection,), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=accept, daemon=True).start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        listener.shutdown(socket.SHUT_RDWR)


CLIENT = """
import json, sys
from pathlib import Path
import numpy as np
from manifeel_ms3.errors import ServerError
from manifeel_ms3.evaluation.remote_policy import RemotePolicy

def megabytes(name):
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) / 1024

for attack in sys.argv[2:]:
    policy = RemotePolicy(f"{sys.argv[1]}/{attack.replace(' ', '_')}", timeout=30)
    Path("/proc/self/clear_refs").write_text("5")  # the peak of memory is measured from here
    before = megabytes("VmRSS")
    try:
        said = repr(policy.act(dict(x=np.zeros((1, 2)))))
    except ServerError as error:
        said = "refused"
    print(json.dumps([attack, said, megabytes("VmHWM") - before]), flush=True)
"""
ATTACKS = (
    *HOSTILE_CONTENTS,
    *("endless", "endless, with a length", "endless error", "endless chunk", "endless headers"),
)


def test_a22_no_answer_takes_more_than_300_megabytes(figure):
    mark = Path("/tmp/code_from_a_server_ran")
    mark.unlink(missing_ok=True)
    with hostile_server() as address:
        done = subprocess.run(
            [sys.executable, "-c", CLIENT, address, *ATTACKS], cwd=REPOSITORY, capture_output=True, text=True, check=False
        )
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert [attack for attack, *_ in told] == list(ATTACKS), done.stderr[-2000:]
    for attack, said, megabytes in told:
        assert said == "refused", attack
        figure("megabytes that a hostile answer takes", megabytes, at_most=300)
    assert not mark.exists()


@pytest.mark.parametrize("dtype", ["<f8", "<f4", ">f4", "<i8", "|u1"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_a22_honest_actions_arrive(dtype, save):
    class Answers:
        def act(self, obs):
            return np.arange(6).astype(dtype)

    program = example(MyPolicy=Answers)
    program.Handler.act.__globals__["np"] = SimpleNamespace(savez=save, load=np.load)
    with served(program.Handler) as address:
        policy = RemotePolicy(address)
        policy.reset()
        assert policy.act(OBSERVATION).tolist() == [0, 1, 2, 3, 4, 5]


# ------------------------------------------------------------------------------- proxies, passwords, many clients


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost"])
def test_a23_a_server_on_this_machine_is_asked_without_a_proxy(name, monkeypatch):
    for variable in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("http_proxy", NOT_THERE)
    with served(example(MyPolicy=CountsSteps).Handler) as address:
        policy = RemotePolicy(address.replace("127.0.0.1", name))
        policy.reset()
        assert step_of(policy) == 1


def test_a23_other_machines_are_asked_through_the_proxy(monkeypatch):
    asked = []

    class Proxy(example().Handler):
        def do_POST(self):  # noqa: N802
            asked.append(self.path)
            self.path = "/reset"
            super().do_POST()

    for variable in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(variable, raising=False)
    with served(Proxy) as address:
        monkeypatch.setenv("http_proxy", address)
        RemotePolicy("http://policy.example:8000").reset()
    assert asked == ["http://policy.example:8000/reset"]


def test_b08_the_password_of_a_server_is_sent_and_not_published(tmp_path):
    class Asks(example().Handler):
        def do_POST(self):  # noqa: N802
            if self.headers["Authorization"] != "Basic " + b64encode(b"me:hunter22").decode():
                self.send_error(401)
            else:
                super().do_POST()

    with served(Asks) as address:
        out = tmp_path / "evaluation.json"
        main(args_of(address.replace("//", "//me:hunter22@"), out))
        text = out.read_text()
        assert "hunter22" not in text
        assert [episode["error"] for episode in json.loads(text)["episodes"]] == [None, None]
        with pytest.raises(PolicyUnavailableError, match="401") as raised:
            RemotePolicy(address.replace("//", "//me:hunter23@")).reset()
        assert "hunter23" not in str(raised.value)


def test_a24_the_example_serves_others_while_a_client_sends_half_a_body(figure):
    handler = example(MyPolicy=CountsSteps).Handler
    handler.timeout = 1.0
    with served(handler) as address, socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2]))) as half:
        half.sendall(b"POST /act HTTP/1.1\r\nContent-Length: 100\r\n\r\nhalf")
        begin = time.monotonic()
        policy = RemotePolicy(address, timeout=10)
        policy.reset()
        assert step_of(policy) == 1
        figure("seconds that half a request delays others", time.monotonic() - begin, at_most=0.9)
        half.settimeout(10)
        while half.recv(4096):
            pass  # it is told what is wrong, and then cut off
        figure("seconds until half a request is cut off", time.monotonic() - begin, at_most=5)


def test_a24_the_example_refuses_a_body_that_is_too_long():
    with served(example(MAX_BODY=1000).Handler) as address:
        policy = RemotePolicy(address)
        policy.reset()
        with pytest.raises(ServerError, match=r"refused|cannot be reached"):
            policy.act(dict(x=np.zeros((1, 1000))))
