"""A policy that lives in another process, Python or machine, asked over HTTP; `examples/policy_server.py` is the other end.

`POST /reset`: nothing in, nothing out. `POST /act`: an npz with an array for every observation, named by its path
("sensor_data/wrist/rgb", uint8 (H, W, 3)); out an npz with "action", (A,). An error is a status other than 200 and its text.
"""

import io
from collections.abc import Iterator
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import urlopen

import numpy as np
from mani_skill.utils import common


class RemotePolicy:
    """Asks a server.

    Args:
        address: such as "http://localhost:8000".
        timeout: s, of an answer.

    Raises:
        ConnectionError: there is no server, or it answers with an error.
    """

    def __init__(self, address: str, timeout: float = 60.0):
        self.address, self.timeout = address.rstrip("/"), timeout

    def reset(self) -> None:
        self._ask("reset", b"")

    def act(self, obs: dict[str, Any]) -> np.ndarray:
        buffer = io.BytesIO()
        np.savez(buffer, **dict(flat_observation(obs)))
        with np.load(io.BytesIO(self._ask("act", buffer.getvalue())), allow_pickle=False) as answer:
            return answer["action"]

    def _ask(self, what: str, body: bytes) -> bytes:
        try:
            with urlopen(f"{self.address}/{what}", body, self.timeout) as answer:
                return answer.read()
        except HTTPError as error:
            raise ConnectionError(f"{self.address} answers {what} with {error.code}: {error.read().decode()[:500]}") from error
        except URLError as error:
            raise ConnectionError(f"{self.address} cannot be reached ({error.reason}); start the server first") from error


def flat_observation(obs: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Every observation by its path, without the environments' axis."""
    for name, value in obs.items():
        if isinstance(value, dict):
            yield from flat_observation(value, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", common.to_numpy(value)[0]
