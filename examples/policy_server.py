"""Serve a policy over HTTP, from any Python that has numpy; nothing of ManiFeel needs to be installed there.

python examples/policy_server.py --port 8000
manifeel eval --policy http://localhost:8000 --env-id ManiFeel-PegInsertion-v1 --obs-mode rgb+tacff
"""

import argparse
import io
from collections import OrderedDict
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Lock

import numpy as np

MAX_EPISODES = 64  # number of episodes that can run at the same time; older ones are forgotten
MAX_BODY = 2**28  # largest size of the observations of one step, bytes


class MyPolicy:
    """Replace this policy, which only moves downwards, with your own. There is one object for each episode; load weights once,
    outside of the class."""

    def __init__(self):
        self.steps = 0

    def act(self, obs):  # obs["sensor_data/wrist/rgb"] is (256, 256, 3), obs["extra/tcp_pose"] is (7,), ...
        self.steps += 1
        return np.array([0.0, 0.0, -0.5, 0.0, 0.0, 0.0])


class Handler(BaseHTTPRequestHandler):
    timeout = 60  # longest silence of a client, s
    policies = OrderedDict()  # noqa: RUF012  (by the name of the episode in the header X-Episode, the latest last)
    lock = Lock()  # one policy is asked at a time

    def handle(self):
        with suppress(ConnectionError):  # the client has gone, such as an evaluation that was interrupted
            super().handle()

    def do_POST(self):
        try:
            length = int(self.headers["Content-Length"])
            if not 0 <= length <= MAX_BODY:
                raise ValueError(f"a body of {length} bytes is refused")
            body = self.rfile.read(length)
            with self.lock:
                status, content = self.answer(body)
        except Exception as error:  # the evaluation records the message, and goes on with the next episode
            status, content = 500, f"{type(error).__name__}: {error}".encode()
        self.send_response(status)
        self.send_header("X-Episode", self.headers.get("X-Episode", ""))
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def answer(self, body):
        if self.path == "/reset":
            return self.reset()
        if self.path == "/act":
            return self.act(body)
        return 404, f"{self.path} is neither /reset nor /act; give --policy http://host:port without a path".encode()

    def reset(self):
        self.policies[self.headers["X-Episode"]] = MyPolicy()
        while len(self.policies) > MAX_EPISODES:
            self.policies.popitem(last=False)
        return 200, b""

    def act(self, body):
        episode = self.headers["X-Episode"]
        if episode not in self.policies:  # the server was started again, for example; the evaluation ends
            return 410, b"this episode is unknown or was forgotten"
        self.policies.move_to_end(episode)
        answer = io.BytesIO()
        np.savez(answer, action=self.policies[episode].act(dict(np.load(io.BytesIO(body), allow_pickle=False))))
        return 200, answer.getvalue()

    def log_message(self, format, *args):
        """Keep silent about requests."""


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Serve a policy over HTTP.")
    parser.add_argument("--port", type=int, default=8000, help="Port that the server listens on.")
    with suppress(KeyboardInterrupt):  # Ctrl-C ends it
        ThreadingHTTPServer(("127.0.0.1", parser.parse_args().port), Handler).serve_forever()
