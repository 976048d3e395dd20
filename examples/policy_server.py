"""Serve a policy over HTTP, from any Python that has numpy; nothing of ManiFeel needs to be installed there.

python examples/policy_server.py --port 8000
python -m manifeel_ms3.evaluation.evaluate --policy http://localhost:8000 --env-id ManiFeel-PegInsertion-v1 --obs-mode rgb+tacff
"""

import argparse
import io
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np


class MyPolicy:
    """Replace this policy, which only moves downwards, by your own."""

    def reset(self):
        self.steps = 0

    def act(self, obs):  # obs["sensor_data/wrist/rgb"] is (256, 256, 3), obs["extra/tcp_pose"] is (7,), ...
        self.steps += 1
        return np.array([0.0, 0.0, -0.5, 0.0, 0.0, 0.0])


class Handler(BaseHTTPRequestHandler):
    policy = MyPolicy()

    def do_POST(self):
        body, answer, status = self.rfile.read(int(self.headers["Content-Length"])), io.BytesIO(), 200
        try:
            if self.path == "/reset":
                self.policy.reset()
            else:
                np.savez(answer, action=self.policy.act(dict(np.load(io.BytesIO(body), allow_pickle=False))))
        except Exception as error:  # the evaluation records the message, and goes on with the next episode
            answer, status = io.BytesIO(f"{type(error).__name__}: {error}".encode()), 500
        self.send_response(status)
        self.end_headers()
        self.wfile.write(answer.getvalue())

    def log_message(self, format, *args):
        """Keep silent about requests."""


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Serve a policy over HTTP.")
    parser.add_argument("--port", type=int, default=8000, help="Port that the server listens on.")
    HTTPServer(("127.0.0.1", parser.parse_args().port), Handler).serve_forever()
