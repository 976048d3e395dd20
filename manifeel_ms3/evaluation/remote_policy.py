"""A policy in another process or on another machine, reached over HTTP; `examples/policy_server.py` is a server for it.

`POST /reset` has an empty body and an empty answer. The body of `POST /act` is an npz with one array for each observation,
named by its path ("sensor_data/wrist/rgb", uint8 (H, W, 3)), or "state" where the observation is the state alone; the answer is
an npz with the array "action", (A,). An error is a status other than 200, with the message as text.

Every request has the header `X-Episode`, a name of the episode that no other episode has. The server keeps the states of
episodes apart by it, since several processes may run episodes at the same time, and repeats the header in its answer.

Nothing that a server sends is trusted: an answer is read up to a limit, and the shape and the type of its array are checked
before the array is made.
"""

import base64
import io
import ipaddress
import math
import zipfile
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPException, HTTPResponse, HTTPSConnection
from typing import Any
from urllib.error import HTTPError
from urllib.parse import SplitResult, unquote, urlsplit
from urllib.request import (
    HTTPHandler,
    HTTPRedirectHandler,
    HTTPSHandler,
    OpenerDirector,
    ProxyHandler,
    Request,
    build_opener,
)
from uuid import uuid4

import numpy as np
import torch
from mani_skill.utils import common

from manifeel_ms3.arguments import is_number
from manifeel_ms3.errors import InvalidArgumentError, ServerError

from .policy import STEP_TIMEOUT, PolicyUnavailableError

EPISODE = "X-Episode"
"""Header that names the episode."""
UNAVAILABLE = (*range(300, 400), 401, 403, 404, 405, 407, 410, 501, 502, 503, 504)
"""HTTP statuses that are no fault of the policy: the server has moved, refuses the password, serves no policy here, or has
forgotten the episode; or a proxy cannot reach it."""
LONGEST_MESSAGE = 500
"""Number of characters of a server's error message that are shown; the rest, often a page of HTML, is cut off. Set once, not
tuned."""
CONNECT_TIMEOUT = 10.0
"""Longest time in s to wait for a connection; at most half of the time for an answer. It is short, so that a server that cannot
be reached can be distinguished from a slow policy, which has a time limit of its own."""
MAX_ANSWER = 2**20
"""Largest number of bytes of an answer that are read; an npz with one action has a few hundred."""
MAX_HEADER = 256
"""Largest number of bytes of an array's header; numpy writes 118 for an action."""
MAX_NUMBERS = 4096
"""Largest number of elements of an action, far more than a robot has joints."""
LARGEST_NUMBER = 16
"""Largest number of bytes of one element, that of a long double."""
ARRAY_READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
"""Readers of the header by the version of the npy format; later versions only differ in the names of fields."""


class RemotePolicy:
    """A policy that asks a server for its actions; a failing server raises a `ServerError`.

    Args:
        address: Address of the server, such as "http://localhost:8000" or "http://user:password@host:8000".
        timeout: Longest time to wait for an answer, in s.

    Raises:
        InvalidArgumentError: The address is not that of a web server, or the time is not a positive number.
    """

    def __init__(self, address: str, timeout: float = STEP_TIMEOUT):
        parts = _parts_of(address)
        if not is_number(timeout) or timeout <= 0:
            raise InvalidArgumentError(f"timeout={timeout!r} of the policy's server must be a number of seconds above 0")
        login, _, host = parts.netloc.rpartition("@")
        self.address, self.timeout = parts._replace(netloc=host).geturl().rstrip("/"), timeout
        self._headers = {"Content-Type": "application/octet-stream"}
        if login:
            self._headers["Authorization"] = "Basic " + base64.b64encode(unquote(login).encode()).decode()
        self._opener = _opener_for(str(parts.hostname))
        self._episode = ""

    def reset(self) -> None:
        self._episode = uuid4().hex
        self._post("reset", b"")

    def act(self, obs: dict[str, Any] | torch.Tensor) -> np.ndarray:
        buffer = io.BytesIO()
        tree = obs if isinstance(obs, dict) else dict(state=obs)  # in the mode "state", the observation is the vector itself
        arrays: dict[str, Any] = dict(flat_observation(tree))
        np.savez(buffer, **arrays)
        return read_action(self._post("act", buffer.getvalue()))

    def _post(self, endpoint: str, body: bytes) -> bytes:
        """The answer to a request.

        Raises:
            PolicyUnavailableError: The server cannot be reached, or is not a policy server.
            ServerError: The server answers with an error, with too many bytes, or not in time.
        """
        request = Request(f"{self.address}/{endpoint}", body, {**self._headers, EPISODE: self._episode})
        try:
            with self._opener.open(request, timeout=self.timeout) as answer:
                content, episode, rest = answer.read(MAX_ANSWER + 1), answer.headers.get(EPISODE), answer.length
        except HTTPError as error:
            message = f"{self.address} answers {endpoint} with {error.code}: {_message_of(error)}"
            raise (PolicyUnavailableError if error.code in UNAVAILABLE else ServerError)(message) from error
        except TimeoutError as error:
            raise ServerError(f"{self.address} does not answer {endpoint} within {self.timeout:g} s") from error
        except (OSError, HTTPException) as error:
            reason = getattr(error, "reason", None) or str(error) or type(error).__name__
            raise PolicyUnavailableError(f"{self.address} cannot be reached ({reason}); start the server first") from error
        if len(content) > MAX_ANSWER:
            raise ServerError(f"{self.address} answers {endpoint} with more than {MAX_ANSWER} bytes; an action has hundreds")
        if rest:
            raise PolicyUnavailableError(f"{self.address} broke off its answer to {endpoint}; start the server again")
        if episode != self._episode:
            raise PolicyUnavailableError(
                f"{self.address} does not repeat the header {EPISODE} of {endpoint}, so it may mix the states of episodes; "
                "serve the policy as examples/policy_server.py does"
            )
        return content


def read_action(content: bytes) -> np.ndarray:
    """The array "action" of an npz that a server sent.

    Raises:
        ServerError: The content is not an npz with such an array of numbers, or the array is too large.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entry = archive.getinfo("action.npy")
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError("the array is compressed by another method than that of np.savez_compressed")
            with archive.open(entry) as file:  # no more is decompressed than is read
                return _array_of(file.read(2 * MAX_HEADER + MAX_NUMBERS * LARGEST_NUMBER))
    except Exception as error:  # zipfile and numpy raise errors of many types
        raise ServerError(
            f"the answer is no npz with an array 'action' of numbers ({type(error).__name__}: {error}); "
            "write it with np.savez(file, action=action)"
        ) from error


def _array_of(content: bytes) -> np.ndarray:
    """The array of an npy file, whose header is checked before memory is taken for the array."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version not in ARRAY_READERS:
        raise ValueError(f"the npy format has version {version}")
    shape, fortran_order, dtype = ARRAY_READERS[version](file, max_header_size=MAX_HEADER)
    if dtype.kind not in "fiu":
        raise ValueError(f"the array has the type {dtype}")
    if min(shape, default=0) < 0 or math.prod(shape) > MAX_NUMBERS:
        raise ValueError(f"the array has the shape {shape}")
    flat = np.frombuffer(content, dtype, math.prod(shape), file.tell())
    return flat.reshape(shape, order="F" if fortran_order else "C")


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


def _parts_of(address: str) -> SplitResult:
    try:
        parts = urlsplit(address)
        valid = bool(parts.hostname) and not parts.query and parts.port != 0  # `port` raises where it is no number
    except ValueError:
        valid = False
    if not valid:
        raise InvalidArgumentError(
            "the address of the policy's server is not a web address; give one like http://localhost:8000"
        )
    return parts


def _opener_for(host: str) -> OpenerDirector:
    """Opener of a host's addresses: directly if it is this machine, else through the proxy that the environment names."""
    try:
        loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = host == "localhost" or host.endswith(".localhost")
    handlers = (_NoRedirects, _Http, _Https)
    return build_opener(*handlers, ProxyHandler({})) if loopback else build_opener(*handlers)


class _Connects(HTTPConnection):
    """A connection whose establishment has a time limit of its own."""

    def connect(self) -> None:
        answer = self.timeout
        self.timeout = CONNECT_TIMEOUT if answer is None else min(CONNECT_TIMEOUT, answer / 2)
        super().connect()
        self.timeout = answer
        self.sock.settimeout(answer)


class _ConnectsSafely(_Connects, HTTPSConnection):
    """A connection with TLS whose establishment has a time limit of its own."""


class _Http(HTTPHandler):
    def http_open(self, req: Request) -> HTTPResponse:
        return self.do_open(_Connects, req)


class _Https(HTTPSHandler):
    def https_open(self, req: Request) -> HTTPResponse:
        return self.do_open(_ConnectsSafely, req)


class _NoRedirects(HTTPRedirectHandler):
    """Handler to which redirections are errors, because they would send observations and passwords to another address."""

    def redirect_request(self, *_: Any) -> None:
        return None


def _message_of(error: HTTPError) -> str:
    try:
        with error:
            return error.read(4 * LONGEST_MESSAGE).decode(errors="replace")[:LONGEST_MESSAGE]  # UTF-8: at most 4 bytes each
    except (OSError, HTTPException):
        return "(the message broke off)"
