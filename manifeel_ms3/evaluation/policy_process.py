"""One process that holds a policy and answers all episodes in batches, whichever processes simulate them.

    simulating processes                         main process                     policy's process
    SharedPolicy.act  --- PolicyRequest --->  PolicyProcess (a thread)  --- batch --->  answer_batches
                      <------ answer -------                            <-- answers ---

The main process passes requests on, so that it knows which of them the policy was working on when it crashed or hung. These
requests are sent again, one by one, to a new process, and only a request that makes the policy crash or hang on its own fails
its episode.
"""

import contextlib
import multiprocessing
import pickle
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np
import torch

from manifeel_ms3.errors import WorkFailedError
from manifeel_ms3.workers import WorkerContext, end_with_parent, portable, without_ctrl_c

from .policy import Policy, PolicyOfPart, PolicyRequest, PolicySource, PolicyUnavailableError, with_defaults
from .rollout import PolicyFault

FIRST_ANSWER = 120.0
"""Time in s that the first answer of a process may take beyond the usual limit, because libraries initialize themselves; set
once, not tuned."""
ENDED = "the process that holds the policy has ended; run the command again"
LONGEST_FOLDER = 60
"""Largest number of characters in the path of the folder for temporary files. If it is longer, /tmp is used, because the path
of a Unix socket has 107 characters at most (man 7 unix)."""
BACKLOG = 128
"""Number of simulating processes that may wait to be connected; more than any machine runs at once."""
LEAST_WAIT = 0.05
"""Time in s that passes after a deadline before it is checked, and that the policy's process has to end by itself before it is
killed; set once, not tuned."""


@dataclass(frozen=True)
class Ready:
    """Message of the policy's process: it has made the policy."""

    make_episode_part: bytes | None
    """`BatchPolicy.make_episode_part`, pickled, which the main process passes on as it is; None for a policy that answers one
    episode only."""
    batch_size: int = 1
    """Largest number of requests that are answered together."""


@dataclass
class _Caller:
    """A simulating process."""

    connection: Connection
    knows_policy: bool = False
    """Whether it has been sent the policy's description."""
    request: PolicyRequest | None = None
    """The request that waits for its answer."""
    asked_at: float = 0.0
    """Time of the request in s, by `time.monotonic`."""
    alone: bool = False
    """Whether the request must be sent alone, because another request of its batch may have ended the policy's process."""


class PolicyProcess:
    """The policy's process, as the main process sees it. It is a context manager: the process runs while the context lasts.

    Args:
        source: Place that the policy comes from.
        answer_timeout: Longest time in s that the policy may take for one batch.
    """

    def __init__(self, source: PolicySource, answer_timeout: float):
        self._source, self._timeout = source, answer_timeout
        short = len(tempfile.gettempdir()) <= LONGEST_FOLDER
        # only this user may enter it
        self._folder = tempfile.TemporaryDirectory(prefix="manifeel-", dir=None if short else "/tmp")
        self.address = str(Path(self._folder.name) / "policy")
        """Path of the socket to which simulating processes connect."""
        self._callers: dict[Connection, _Caller] = {}
        self._busy: list[_Caller] = []
        self._deadline = 0.0
        self._ready: Ready | Exception | None = None
        self._answered, self._begun = 0, 0.0
        self._end_reading, self._end_writing = multiprocessing.Pipe(duplex=False)

    def __enter__(self) -> "PolicyProcess":
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(self.address)
        self._listener.listen(BACKLOG)
        self._start()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        with without_ctrl_c():
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end_writing.send(None)
        self._thread.join()
        self._stop()
        self._folder.cleanup()

    # ---------------------------------------------------------------- the policy's process

    def _start(self) -> None:
        self._ready, self._answered = None, 0
        context = WorkerContext()
        self._policy, theirs = context.Pipe()
        self._process = context.Process(target=answer_batches, args=(self._source, theirs), daemon=True)
        self._process.start()
        theirs.close()

    def _stop(self) -> int | None:
        """End the process, and return its exit code."""
        self._policy.close()
        self._process.join(LEAST_WAIT)
        self._process.kill()
        self._process.join()
        return self._process.exitcode

    # ---------------------------------------------------------------- the thread

    def _serve(self) -> None:
        try:
            self._pass_on()
        finally:  # so that callers notice that nobody answers any more
            self._listener.close()
            for connection in self._callers:
                connection.close()

    def _pass_on(self) -> None:
        while True:
            sources = [self._listener, self._end_reading, *self._callers]
            sources += [self._policy] if self._is_alive else []
            for source in wait(sources, self._time_left()):
                if source is self._end_reading:
                    return
                if source is self._listener:
                    self._accept()
                elif source is self._policy:
                    self._hear_policy()
                else:
                    self._hear_caller(self._callers[source])  # pyright: ignore[reportArgumentType]
            if self._busy and time.monotonic() > self._deadline:
                self._process.kill()
                self._policy_ended(f"no answer within {self._timeout:g} s")
            self._tell_callers()
            self._ask_next_batch()

    @property
    def _is_alive(self) -> bool:
        """Whether there is a process that loads or holds the policy."""
        ready = self._ready
        return ready is None or (isinstance(ready, Ready) and ready.make_episode_part is not None)

    def _time_left(self) -> float | None:
        return max(self._deadline - time.monotonic(), 0.0) + LEAST_WAIT if self._busy else None

    def _accept(self) -> None:
        connection = Connection(self._listener.accept()[0].detach())
        self._callers[connection] = _Caller(connection)

    def _hear_caller(self, caller: _Caller) -> None:
        try:
            caller.request, caller.asked_at, caller.alone = caller.connection.recv(), time.monotonic(), False
        except (EOFError, OSError):  # the process has ended
            del self._callers[caller.connection]
            caller.connection.close()
            caller.request = None

    def _hear_policy(self) -> None:
        try:
            message = self._policy.recv()
        except (EOFError, OSError):
            self._process.join()
            self._policy_ended(f"the policy's process ended with exit code {self._process.exitcode}: it crashed")
            return
        if self._ready is None:
            self._ready = message
            return
        self._answered += 1
        busy, self._busy = self._busy, []
        for caller, answer in zip(busy, message, strict=True):
            self._reply(caller, answer)

    def _policy_ended(self, reason: str) -> None:
        """Start the process again. A request that was sent alone fails; those of a batch are sent again, one by one."""
        self._stop()
        if self._ready is None:
            self._ready = WorkFailedError(f"{reason}, before the policy was loaded; as happens where memory runs out")
            return
        busy, self._busy = self._busy, []
        for caller in busy:
            if len(busy) == 1:
                self._reply(caller, PolicyFault(reason))
            else:
                caller.alone = True
        self._start()

    def _reply(self, caller: _Caller, answer: Any) -> None:
        waited = max(self._begun - caller.asked_at, 0.0)
        caller.request = None
        _send(caller.connection, (answer, waited))

    def _tell_callers(self) -> None:
        """Send new callers the policy's description, and waiting callers the error if the policy cannot be loaded any more."""
        for caller in self._callers.values() if self._ready is not None else ():
            if not caller.knows_policy:
                caller.knows_policy = True
                _send(caller.connection, self._ready)
            elif caller.request is not None and isinstance(self._ready, Exception):
                reason = f"the policy crashed and could not be loaded again ({type(self._ready).__name__}: {self._ready})"
                self._reply(caller, PolicyUnavailableError(f"{reason}; run the command again, which keeps finished episodes"))

    def _ask_next_batch(self) -> None:
        if self._busy or not isinstance(self._ready, Ready):
            return
        waiting = sorted((c for c in self._callers.values() if c.request is not None), key=lambda c: c.asked_at)
        alone = [caller for caller in waiting if caller.alone][:1]
        batch = alone or waiting[: self._ready.batch_size]
        if not batch:
            return
        self._busy, self._begun = batch, time.monotonic()
        self._deadline = self._begun + self._timeout + (0.0 if self._answered else FIRST_ANSWER)
        _send(self._policy, [caller.request for caller in batch])


def _send(connection: Connection, message: Any) -> None:
    with contextlib.suppress(OSError):  # whoever has ended is noticed where messages are received
        connection.send(message)


# -------------------------------------------------------------------- in a simulating process


class SharedPolicy(PolicyOfPart):
    """The policy of a `PolicyProcess`, as an episode in this process sees it.

    Args:
        address: Address of the `PolicyProcess`.
        make: Function that makes a policy for this process alone, if the policy answers one episode only.

    Raises:
        Exception: The error that making the policy raised.
        PolicyUnavailableError: The `PolicyProcess` has ended.
    """

    def __init__(self, address: str, make: Callable[[], Policy]):
        try:
            connection = socket.socket(socket.AF_UNIX)
            connection.connect(address)
            self._connection = Connection(connection.detach())
            ready: Ready = _raised(self._connection.recv())  # once the policy is loaded
        except (EOFError, ConnectionError, FileNotFoundError) as error:
            raise PolicyUnavailableError(ENDED) from error
        part = ready.make_episode_part
        self._part = with_defaults(make() if part is None else pickle.loads(part)(self._ask))
        self.limits_itself = part is not None  # the `PolicyProcess` limits the time, in which others' requests do not count

    def act(self, obs: dict[str, Any]) -> np.ndarray:
        self.waited = 0.0
        return super().act(obs)

    def _ask(self, request: PolicyRequest) -> np.ndarray:
        """The policy's answer to a request.

        Raises:
            PolicyFault: The policy raised an error, crashed, or did not answer in time.
            PolicyUnavailableError: The policy's process has ended.
        """
        try:
            self._connection.send(request)
            answer, self.waited = self._connection.recv()
        except (EOFError, OSError) as error:
            raise PolicyUnavailableError(ENDED) from error
        return _raised(answer)


def _raised(message: Any) -> Any:
    if isinstance(message, Exception):
        raise message
    return message


# -------------------------------------------------------------------- in the policy's process


def answer_batches(source: PolicySource, connection: Connection) -> None:
    """Make the policy, and answer batches of requests until the other end of the connection is closed.

    Each answer is an array, or the exception that the policy raised.
    """
    torch.set_num_threads(1)  # the rounding of sums, and so the episodes, depend on the number of threads
    threading.Thread(target=end_with_parent, daemon=True).start()
    try:
        policy: Any = source.make()
    except Exception as error:
        connection.send(portable(error))
        return
    if not hasattr(policy, "answer"):
        connection.send(Ready(None))
        return
    connection.send(Ready(pickle.dumps(policy.make_episode_part), policy.batch_size))
    with contextlib.suppress(EOFError, OSError):
        while True:
            connection.send(_answers(policy, connection.recv()))


def _answers(policy: Any, requests: list[PolicyRequest]) -> list[np.ndarray | Exception]:
    try:
        answers = policy.answer(requests)
        if len(answers) != len(requests):
            raise PolicyFault(f"it gave {len(answers)} answers to {len(requests)} requests")
        return list(answers)
    except Exception as error:  # a policy may raise anything
        if len(requests) > 1:
            return [answer for request in requests for answer in _answers(policy, [request])]
        known = isinstance(error, PolicyFault | PolicyUnavailableError)
        return [error if known else PolicyFault(f"{type(error).__name__}: {error}")]
