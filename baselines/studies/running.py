"""Runs jobs on Ray, in their order, as far as the resources of this machine or of a cluster reach."""

import logging
import os
import secrets
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ray
from ray._private import ray_constants
from ray.exceptions import RayError, RayTaskError

from manifeel_ms3.errors import MachineError
from manifeel_ms3.network import LOOPBACK
from manifeel_ms3.ownership import is_owned

from .jobs import STARTED, is_done, perform_in, restore_child_signals
from .planning import Job
from .study import Resources, Study

RETRIES = 3
"""Number of times that Ray starts a job again after its worker has died; set once, not tuned."""
POLL_SECONDS = 2
"""Time between two updates of the table, in s; set once, not tuned."""
RESOURCES = (("CPU", "cpus"), ("GPU", "gpus"))
"""Ray's name of each resource, and the field of `Resources` that asks for it."""
FREE_SECONDS, FREE_POLL_SECONDS = 5.0, 0.05
"""Longest wait until Ray counts the resources of a job that has ended as free, and the time between two looks at it."""
SHARE_DECIMALS = 4
"""Decimals with which Ray counts shares of a resource."""
RAY_SETTINGS = {
    "RAY_worker_niceness": "0",
    "RAY_kill_child_processes_on_worker_exit_with_raylet_subreaper": "true",  # the children of a killed worker end with it
    "RAY_get_check_signal_interval_milliseconds": "100",  # else Ctrl-C is noticed up to 1 s later
    "RAY_enable_autoscaler_v2": "true",  # the first version's process waits 1 s for a server that has ended before it ends
}
"""Environment variables of a Ray that is started here, unless they are set."""
CODE = Path(__file__).parents[2]
"""Folder that these packages are imported from."""


def run_jobs(study: Study, jobs: list[Job], root: Path, address: str | None, show: Callable[[], None]) -> dict[str, str]:
    """Run every job that is not done, and return what jobs raised, by their keys.

    A job is given to Ray when its resources are free, so that jobs run in the study's order: Ray itself would do all recordings
    first, since these wait for nothing. A job that another study does at present waits until that study has done it or stops.

    Args:
        study: The study, which says what each kind of job needs.
        jobs: Its jobs, each after those that it needs.
        root: Folder of all jobs, as an absolute path.
        address: Address of a Ray cluster; this machine if None.
        show: Called every few seconds, to show the progress.

    Raises:
        MachineError: Ray does not start, cannot be reached, or has no machine that is large enough.
    """
    _start_ray(address)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # again, since Ray sets a handler that prints a stack trace
    restore_child_signals()
    try:
        worker: Any = ray.remote(max_calls=1, max_retries=RETRIES)(perform_in)  # a new process for each job
        _require_resources(study)
        results: dict[str, Any] = {}
        waiting, running = [job for job in jobs if not is_done(job, root)], dict[Any, Job]()
        while waiting or running:
            held = {job.key for job in waiting if _is_held(job, root)}
            while job := _next_job(study, held, waiting, running):
                waiting.remove(job)
                needs = study.resources[job.kind]
                _await_free(needs)
                task = worker.options(num_cpus=needs.cpus, num_gpus=needs.gpus, name=job.title)
                needed = [results[need.key] for need in job.needs if need.key in results]
                results[job.key] = task.remote(Path.cwd(), job, root, needs, *needed)
                running[results[job.key]] = job
            if not running and not held:
                raise MachineError(
                    f"{study.name}: {len(waiting)} jobs wait, and no machine of the cluster has room for the first of "
                    f"them, {waiting[0].title}; add a machine, and start the study again, which continues"
                )
            for job in _ended(running):
                if _is_held(job, root):  # another study was faster
                    waiting.insert(0, job)
            show()
        return {key: error for key, result in results.items() if (error := _error(result))}
    finally:
        ray.shutdown()


def _start_ray(address: str | None) -> None:
    """Connect to a cluster, or start a Ray on this machine that only its own processes can reach and command.

    Ray lets its workers import from the current folder, where a stranger's torch.py may lie. It is therefore started from the
    folder that this code is imported from.
    """
    settings: dict[str, Any] = {}
    address = address or "local"
    if address == "local":
        settings = dict(_node_ip_address=LOOPBACK)  # Ray then listens on this address, which no other machine reaches
        os.environ[ray_constants.ENABLE_RAY_CLUSTERS_ENV_VAR] = "0"  # for the processes that Ray starts
        ray_constants.ENABLE_RAY_CLUSTER = False  # else it replaces 127.0.0.1 by this machine's outer address, except on macOS
        os.environ.pop("RAY_AUTH_MODE", None)  # if it is not set, a Ray that is started here asks for a token
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        logging.getLogger("ray._private.authentication").setLevel(logging.ERROR)  # it would say that Ray asks for a token
        for name, value in RAY_SETTINGS.items():
            os.environ.setdefault(name, value)
    here = Path.cwd()
    os.chdir(CODE)
    try:
        ray.init(
            address,
            include_dashboard=False,
            log_to_driver=False,
            logging_level=logging.WARNING,
            configure_logging=False,
            **settings,
        )
    except Exception as error:  # Ray raises a bare one if it has not started within 30 s
        what = "Ray, which runs the jobs, does not start" if settings else f"the Ray cluster {address} cannot be reached"
        mend = "give the same command again when the machine is less busy" if settings else "start it, or correct --address"
        raise MachineError(f"{what} ({' '.join(str(error).split())}); {mend}") from error
    finally:
        os.chdir(here)


def _is_held(job: Job, root: Path) -> bool:
    """Whether another process does a job at present."""
    started = job.folder(root) / STARTED
    return started.is_file() and is_owned(started)


def _ended(running: dict[Any, Job]) -> list[Job]:
    """The jobs that end within the time between two updates of the table; they are removed from those that run."""
    if not running:
        time.sleep(POLL_SECONDS)  # only jobs of other studies run
        return []
    results, _ = ray.wait(list(running), timeout=POLL_SECONDS, fetch_local=False)
    return [running.pop(result) for result in results]


def _next_job(study: Study, held: set[str], waiting: list[Job], running: dict[Any, Job]) -> Job | None:
    """The first waiting job that can start, because the jobs that it needs have ended and its resources are free; or None.

    Args:
        study: The study.
        held: Keys of jobs that other studies do at present, which do not start.
        waiting: The jobs that have not started, in their order.
        running: The jobs that run, by their results.
    """
    taken = [study.resources[job.kind] for job in running.values()]
    available = ray.cluster_resources()
    free = {
        name: round(available.get(name, 0.0) - sum(getattr(one, field) for one in taken), SHARE_DECIMALS)
        for name, field in RESOURCES
    }
    unfinished = {job.key for job in (*waiting, *running.values())}
    for job in waiting:
        needs = study.resources[job.kind]
        fits = needs.cpus <= free["CPU"] and needs.gpus <= free["GPU"]
        if fits and job.key not in held and not any(need.key in unfinished for need in job.needs):
            return job
    return None


def _await_free(needs: Resources) -> None:
    """Wait until Ray counts a job's resources as free as well, some tenths of a second after the job before it has ended.

    Ray prints a warning about a task that it cannot place at once. On a cluster that others use, too, the wait ends after a
    while, and the job waits in Ray.
    """
    deadline = time.monotonic() + FREE_SECONDS
    while time.monotonic() < deadline:
        available = ray.available_resources()
        if all(round(available.get(name, 0.0), SHARE_DECIMALS) >= getattr(needs, field) for name, field in RESOURCES):
            return
        time.sleep(FREE_POLL_SECONDS)


def _error(result: Any) -> str:
    """What a job raised, on one line; "" if it is done."""
    try:
        ray.get(result)
    except RayTaskError as error:
        return str(error.cause).partition("\n")[0]
    except RayError:
        return "its worker died"
    return ""


def _require_resources(study: Study) -> None:
    machines = [machine["Resources"] for machine in ray.nodes() if machine["Alive"]]
    for kind, needs in study.resources.items():
        for name, field in RESOURCES:
            available = max(machine.get(name, 0.0) for machine in machines)  # a job runs on one of them
            if (wanted := getattr(needs, field)) > available:
                raise MachineError(
                    f"{study.name}: {kind} needs {wanted:g} {name}s, and a machine has {available:g} of them; change "
                    "`resources` in the study's file, or give the --address of a Ray cluster"
                )
