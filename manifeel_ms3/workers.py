"""Worker processes: each makes one state, such as an environment, and applies functions to it and to tasks.

with WorkerPool(2, partial(gym.make, "ManiFeel-PegInsertion-v1")) as pool:
    for seed in range(10):
        pool.submit(run_seed, seed)  # calls run_seed(env, seed) in one of the processes
    for finished in pool.as_finished():
        print(finished.task, finished.result())
"""

import gc
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from multiprocessing import active_children, forkserver, resource_tracker
from multiprocessing.context import ForkServerContext, ForkServerProcess
from typing import Any, Generic, TypeVar
from weakref import WeakSet

import torch
from pebble import ProcessExpired, ProcessPool

from .errors import InvalidArgumentError, WorkFailedError
from .typed_modules import imported

State = TypeVar("State")
Task = TypeVar("Task")


SAFE_PATH = "PYTHONSAFEPATH"
"""Environment variable of Python 3.11 and later, with which a new interpreter finds no modules in the current folder."""
_starting = threading.Lock()
"""Lock of the start of the server process, during which an environment variable of this process has another value."""
ENDED_EARLY = os.EX_SOFTWARE
"""Exit code that stands for 0 where a process ends in the midst of its work, for example by `os._exit(0)` in a policy."""


@contextmanager
def _safe_path() -> Iterator[None]:
    """Context in which new interpreters find no modules in the current folder, where anybody's pickle.py may lie."""
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = before


@contextmanager
def without_ctrl_c() -> Iterator[None]:
    """Context in which new processes and threads ignore Ctrl-C, which only the main thread handles."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class WorkerProcess(ForkServerProcess):
    """A process of `WorkerContext`, with the environment variables that this process has as it starts it."""

    @property
    def exitcode(self) -> int | None:
        """The exit code; `ENDED_EARLY` if it is 0, because a worker never ends by itself, and pebble reports no code of 0."""
        code = super().exitcode
        return ENDED_EARLY if code == 0 else code

    @staticmethod
    def _Popen(process_obj: Any) -> Any:  # noqa: N802 (the name is that of multiprocessing)
        _start_server()
        return ForkServerProcess._Popen(process_obj)  # pyright: ignore[reportAttributeAccessIssue]

    def __reduce__(self) -> tuple[Any, ...]:
        return _with_environment, (type(self), dict(os.environ)), self.__dict__


def _with_environment(process_class: type[WorkerProcess], environment: dict[str, str]) -> WorkerProcess:
    """The process in itself, without its attributes; these come next and may import modules, which read the environment."""
    os.environ.clear()
    os.environ.update(environment)
    return process_class.__new__(process_class)


class WorkerContext(ForkServerContext):
    """Context of multiprocessing whose processes start in a fraction of a second and find no modules in the current folder.

    They are forked from a server process that has imported this package and done nothing else, because neither the renderer
    nor threads survive a fork of this process. They ignore Ctrl-C, as the server does.
    """

    def __init__(self) -> None:
        super().__init__()
        self._made: WeakSet[WorkerProcess] = WeakSet()
        _start_server()

    def Process(self, *args: Any, **kwargs: Any) -> WorkerProcess:  # noqa: N802  # pyright: ignore[reportIncompatibleVariableOverride]
        """A process that has not started; the arguments are those of `multiprocessing.Process`."""
        process = WorkerProcess(*args, **kwargs)
        self._made.add(process)
        return process

    def kill(self) -> None:
        """Kill the processes of this context that run; those of other contexts go on."""
        for process in active_children():
            if process in self._made:
                process.kill()


def _start_server() -> None:
    """Start the server process if it does not run, as it may have been killed. Its first process takes seconds to come."""
    forkserver.set_forkserver_preload(["manifeel_ms3.worker_server"])
    with _starting, without_ctrl_c(), _safe_path():
        resource_tracker.ensure_running()  # before the server would start it, because its start lets Ctrl-C through again
        with without_ctrl_c():
            forkserver.ensure_running()


class WorkerDiedError(WorkFailedError):
    """A worker process ended while it worked on a task: it was killed or crashed.

    Args:
        task: The task that the process worked on.
        exit_code: Exit code of the process, which is negative if a signal of that number ended it.
    """

    def __init__(self, task: Any, exit_code: int | None):
        super().__init__(
            f"the process that worked on {task!r} ended with exit code {exit_code}: it crashed, or was killed, as happens "
            "where memory or the disk is full; run the command again, perhaps with fewer processes"
        )
        self.exit_code = exit_code


@dataclass(frozen=True)
class Finished(Generic[Task]):
    """A task that has ended, with a result or with an exception."""

    task: Task
    """The task, as it was submitted."""
    future: "Future[Any]"
    """Future of the task's result."""

    def result(self) -> Any:
        """Return the function's result, or raise its exception.

        Raises:
            WorkerDiedError: The process ended before the function returned.
            WorkFailedError: Worker processes end before they take a task.
        """
        try:
            return self.future.result()
        except ProcessExpired as error:
            raise WorkerDiedError(self.task, error.exitcode) from error
        except BrokenExecutor as error:
            raise WorkFailedError(
                f"the worker processes end as they start ({error}); what they wrote to the terminal says why. Check the "
                "installation with `manifeel doctor`"
            ) from error


class WorkerPool(Generic[State, Task]):
    """Processes that share tasks; if a process dies, its task fails and a new process takes its place.

    Processes are those of `WorkerContext`, and use one thread each for torch, because they share the cores and because sums
    then do not depend on the number of threads. They end when the process that made them is killed.
    If an exception leaves the context, such as the KeyboardInterrupt of Ctrl-C, waiting tasks are cancelled and the processes
    are killed at once. Ctrl-C reaches only the main process.

    Args:
        workers: Number of worker processes.
        make_state: Function that makes the state of one process. It is called before the process's first task, so that its
            exceptions are raised by `Finished.result`. It must be picklable.

    Raises:
        InvalidArgumentError: `workers` is less than 1.
    """

    def __init__(self, workers: int, make_state: Callable[[], State]):
        if workers < 1:
            raise InvalidArgumentError(f"{workers} worker processes are asked for; at least 1 is needed")
        worker = _Worker(make_state)
        self._context = WorkerContext()
        self._pool = ProcessPool(workers, context=self._context, initializer=_start, initargs=(worker, imported()))
        self._running: dict[Future[Any], Task] = {}

    def __enter__(self) -> "WorkerPool[State, Task]":
        return self

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        if failure is None and not self._running:
            self._pool.close()
        else:
            self._pool.stop()
            self._context.kill()  # a request to end would wait until native code returns
        self._pool.join()

    @property
    def num_running(self) -> int:
        """Number of tasks that were submitted and have not been returned by `as_finished`."""
        return len(self._running)

    def submit(self, function: Callable[[State, Task], Any], task: Task) -> None:
        """Call `function(state, task)` in the next process that is free; both must be picklable."""
        with without_ctrl_c():  # for the pool's threads, which start with the first task
            self._running[self._pool.schedule(_run, args=(function, task))] = task

    def as_finished(self) -> Iterator[Finished[Task]]:
        """Tasks in the order in which they finish, until none is left; more may be submitted meanwhile.

        Of tasks that finish at the same time, those with a result come first, because the exception of another may end the
        caller.
        """
        while self._running:
            finished = wait(self._running, return_when=FIRST_COMPLETED).done
            for future in sorted(finished, key=lambda future: future.exception() is not None):
                yield Finished(self._running.pop(future), future)


# -------------------------------------------------------------------- in the worker processes


@dataclass
class _Worker:
    """All that a worker process keeps from one task to the next."""

    make_state: Callable[[], Any]

    @cached_property
    def state(self) -> Any:
        return self.make_state()


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use a number of CPU threads for as long as the context lasts."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


_this_worker: _Worker | None = None
"""The worker of this process; None in a process that is no worker. It is global, since a process keeps its state nowhere
else."""


def _start(worker: _Worker, modules: tuple[str, ...]) -> None:
    global _this_worker
    for module in modules:
        import_module(module)
    gc.freeze()  # ManiSkill collects garbage at every reset; it need not search the modules, which takes 0.1 s and more
    torch.set_num_threads(1)
    threading.Thread(target=end_with_parent, daemon=True).start()
    _this_worker = worker


def end_with_parent() -> None:
    """End this process when its parent process has ended, even if that was killed and could not send a message."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _run(function: Callable[[Any, Any], Any], task: Any) -> Any:
    assert _this_worker is not None
    try:
        return function(_this_worker.state, task)
    except Exception as error:
        if (sent := portable(error)) is error:
            raise
        raise sent from error


def portable(error: Exception) -> Exception:
    """The error, or one with its message where the error, as some of libraries, cannot be sent to another process."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return WorkFailedError(f"{type(error).__name__}: {error}")
    return error
