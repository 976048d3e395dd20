"""A policy in another process or on another machine, asked over HTTP; `examples/policy_server.py` is a server for it.

`POST /reset` has an empty body and an empty answer. The body of `POST /act` is an npz with one array for each observation,
named by its path ("sensor_data/wrist/rgb", uint8 (H, W, 3)); the answer is an npz with the array "action", (A,). An error is a
status other than 200, with the message as text.
"""

import io
from collections.abc import Iterator
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import urlopen

import numpy as np
from mani_skill.utils import common

from manifeel_ms3.errors import ServerError

LONGEST_MESSAGE = 500
"""Characters of a server's error message that are shown; the rest, often a page of HTML, is cut off."""


class RemotePolicy:
    """A policy that asks a server for its actions; a missing or failing server raises a `ServerError`.

    Args:
        address: Address of the server, such as "http://localhost:8000".
        timeout: Longest time to wait for an answer, in s.
    """

    def __init__(self, address: str, timeout: float = 60.0):
        self.address, self.timeout = address.rstrip("/"), timeout

    def reset(self) -> None:
        self._post("reset", b"")

    def act(self, obs: dict[str, Any]) -> np.ndarray:
        buffer = io.BytesIO()
        arrays: dict[str, Any] = dict(flat_observation(obs))
        np.savez(buffer, **arrays)
        with np.load(io.BytesIO(self._post("act", buffer.getvalue())), allow_pickle=False) as answer:
            return answer["action"]

    def _post(self, endpoint: str, body: bytes) -> bytes:
        try:
            with urlopen(f"{self.address}/{endpoint}", body, self.timeout) as answer:
                return answer.read()
        except HTTPError as error:
            message = error.read().decode(errors="replace")[:LONGEST_MESSAGE]
            raise ServerError(f"{self.address} answers {endpoint} with {error.code}: {message}") from error
        except URLError as error:
            raise ServerError(f"{self.address} cannot be reached ({error.reason}); start the server first") from error


def flat_observation(obs: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Pairs of an observation's path ("extra/tcp_pose") and its array, without the leading axis of environments.

    Args:
        obs: Tree of observations of one environment.
        prefix: Path of the tree itself, with a slash at its end; empty at the root.
    """
    for name, value in obs.items():
        if isinstance(value, dict):
            yield from flat_observation(value, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", common.to_numpy(value)[0]
