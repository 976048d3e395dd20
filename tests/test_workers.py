"""One process pool: results as they finish, a state per process, and tasks whose process dies."""

import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest

from manifeel_ms3.errors import InvalidArgumentError, WorkFailedError
from manifeel_ms3.workers import SAFE_PATH, WorkerContext, WorkerDiedError, WorkerPool
from tests.command_process import run_code


def counter(start: int) -> list[int]:
    return [start]


def add(state: list[int], number: int) -> tuple[int, int]:
    """The process that worked, and the sum of what it was given so far."""
    state[0] += number
    return os.getpid(), state[0]


def end(state: list[int], number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def raise_error(state: list[int], number: int) -> None:
    raise KeyError(number)


def sleep(state: list[int], number: int) -> None:
    time.sleep(number)


def environment(state: list[int], name: str) -> tuple[int, str | None]:
    """The server that started this process, and an environment variable."""
    return os.getppid(), os.environ.get(name)


def broken_state() -> None:
    raise InvalidArgumentError("no such environment")


def test_a_process_keeps_its_state_and_more_tasks_may_follow():
    with WorkerPool(1, partial(counter, 10)) as pool:
        pool.submit(add, 1)
        results = []
        for finished in pool.as_finished():
            results.append(finished.result()[1])
            if finished.task < 3:
                pool.submit(add, finished.task + 1)
        assert results == [11, 13, 16]
        assert pool.num_running == 0


def test_a_process_that_dies_fails_its_task_alone():
    with WorkerPool(1, partial(counter, 0)) as pool:
        for number in range(3):
            pool.submit(end, number)
        by_task = {finished.task: finished for finished in pool.as_finished()}
    assert [by_task[number].result() for number in (0, 2)] == [0, 2]
    with pytest.raises(WorkerDiedError, match="worked on 1") as raised:
        by_task[1].result()
    assert raised.value.exit_code == -signal.SIGKILL


def leave(state: list[int], number: int) -> None:
    os._exit(0)


def test_a_process_that_ends_without_an_error_fails_its_task():
    with WorkerPool(1, partial(counter, 0)) as pool:
        pool.submit(leave, 1)
        (finished,) = pool.as_finished()
    with pytest.raises(WorkerDiedError, match="worked on 1 ended with exit code 70"):
        finished.result()


def test_errors_of_a_task_and_of_the_state_are_raised_in_the_caller():
    for make_state, error in ((partial(counter, 0), KeyError), (broken_state, InvalidArgumentError)):
        with WorkerPool(1, make_state) as pool:
            pool.submit(raise_error, 5)
            (finished,) = pool.as_finished()
            with pytest.raises(error):
                finished.result()


class OfALibraryError(Exception):
    """An error that can be sent to another process, but not be made again there."""

    def __init__(self, what: str, number: int):
        super().__init__(f"{what} {number}")


def raise_of_a_library(state: list[int], number: int) -> None:
    raise OfALibraryError("no solution for", number)


def test_an_error_that_cannot_be_sent_fails_its_task_alone():
    with WorkerPool(1, partial(counter, 0)) as pool:
        pool.submit(raise_of_a_library, 5)
        pool.submit(add, 2)
        failed, other = sorted(pool.as_finished(), key=lambda finished: finished.task != 5)
    assert other.result()[1] == 2
    with pytest.raises(WorkFailedError, match="OfALibraryError: no solution for 5"):
        failed.result()


def fail_while_tasks_run() -> None:
    with WorkerPool(1, partial(counter, 0)) as pool:
        for _ in range(3):
            pool.submit(sleep, 100)
        raise ZeroDivisionError


def test_an_exception_ends_tasks_that_run_and_wait():
    before = time.monotonic()
    with pytest.raises(ZeroDivisionError):
        fail_while_tasks_run()
    assert time.monotonic() - before < 50


def test_an_exception_does_not_end_the_processes_of_another_pool():
    with WorkerPool(1, partial(counter, 0)) as other:
        other.submit(add, 1)
        (first,) = other.as_finished()
        with pytest.raises(ZeroDivisionError):
            fail_while_tasks_run()
        other.submit(add, 2)
        (second,) = other.as_finished()
    process, total = second.result()
    assert (process, total) == (first.result()[0], 3)  # the same process, with its state


class EndsTheProcess:
    """A state's maker that ends the process that unpickles it, as a module does that no longer imports."""

    def __reduce__(self):
        return os._exit, (1,)


def test_processes_that_end_as_they_start_are_one_error():
    with WorkerPool(1, EndsTheProcess()) as pool:
        pool.submit(add, 1)
        (finished,) = pool.as_finished()
        with pytest.raises(WorkFailedError, match="end as they start"):
            finished.result()


def test_no_workers_are_refused():
    with pytest.raises(InvalidArgumentError, match="at least 1"):
        WorkerPool(0, partial(counter, 0))


def test_processes_have_the_environment_of_their_pool_even_after_their_server_was_killed(monkeypatch):
    servers = []
    for number in "12":
        monkeypatch.setenv("MANIFEEL_TEST", number)
        with WorkerPool(1, partial(counter, 0)) as pool:
            pool.submit(environment, "MANIFEEL_TEST")
            ((server, value),) = (finished.result() for finished in pool.as_finished())
        assert value == number
        servers.append(server)
        os.kill(server, signal.SIGKILL)
        os.waitid(os.P_PID, server, os.WEXITED | os.WNOWAIT)
    assert servers[0] != servers[1]


NO_GPU = """
import torch

def used(*_, **__):
    raise AssertionError("a GPU is used as the package is imported")

torch.cuda.is_available = torch.cuda.device_count = torch.cuda.init = used
import manifeel_ms3.worker_server
from warp._src import context
assert context.runtime is None
print("imported")
"""


def test_starts_in_several_threads_leave_the_environment_as_it_was(monkeypatch):
    """Pebble's threads and that of a policy's process start processes, perhaps at the same time."""
    monkeypatch.delenv(SAFE_PATH, raising=False)
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(lambda _: WorkerContext(), range(1000)))  # the executor raises what a thread raises
    assert SAFE_PATH not in os.environ


def test_the_server_uses_no_gpu(tmp_path):
    """CUDA does not work in processes that are forked from one that has used it."""
    done = run_code(NO_GPU, folder=tmp_path)
    assert (done.returncode, done.stdout) == (0, "imported\n"), done.stderr
