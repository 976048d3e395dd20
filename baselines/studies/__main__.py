"""Run a study: `manifeel study configs/smoke.yaml`.

A study records demonstrations, trains policies on them and evaluates these policies, for every combination that its file
lists. It runs on Ray: on this machine, or with `--address` on a cluster whose machines share the folder. Each job's output is
kept in a folder that is named by everything the job depends on, and no job is done twice. A worker that dies is started
again, and a study that was stopped goes on where it stopped.
"""

import logging
import os
import secrets
import signal
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import ray
import torch
import tyro
from ray._private import ray_constants
from ray.exceptions import RayError, RayTaskError
from rich.console import Console, Group
from rich.live import Live
from rich.progress import track
from rich.table import Table

from manifeel_ms3.command_line import as_typed, run
from manifeel_ms3.errors import MachineError, WorkFailedError
from manifeel_ms3.network import LOOPBACK
from manifeel_ms3.ownership import is_owned

from . import cost
from .checks import require_valid_environments, require_valid_flags
from .command_lines import shell_command
from .jobs import FAILED, STARTED, Status, is_done, perform_in, read_status, restore_child_signals, status_of
from .planning import Job, jobs_of
from .publish import publish
from .study import KINDS, Kind, Resources, Study, read_study

log = logging.getLogger(__name__)
RETRIES = 3
"""Number of times that Ray starts a job again after its worker has died; set once, not tuned."""
SHOWN = 8
"""Largest number of running jobs in the table; set once, not tuned."""
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
FILE_WIDTH = 160
"""Number of characters of a line if the output is not a terminal; wide enough for the tables."""
CODE = Path(__file__).parents[2]
"""Folder that these packages are imported from."""


@dataclass
class Args:
    """Arguments of `manifeel study`."""

    study: tyro.conf.Positional[Path]
    """Path of the study's file in yaml; `configs/` has examples."""
    root: Path = Path("runs/study")
    """Folder of the output of all jobs. Studies can share it: a job that two studies have in common is done once."""
    address: str | None = None
    """Address of a Ray cluster; this machine if not given."""
    dry_run: bool = False
    """Print the plan and the hours that it will take, without running it."""
    publish: Path | None = None
    """Folder of a submission on the leaderboard, such as leaderboard/cpu, into which the results that are done are copied, with
    a checkpoint of each row; nothing is run. Other results of the folder stay. Only evaluations with `half_precision: true` are
    copied."""
    name: str | None = None
    """Name of that submission; if not given, that which it has, or that of its folder."""
    authors: str | None = None
    """Names of the authors of that submission, which a new one needs; those that it has if not given."""
    print_commands: bool = False
    """Print the shell commands that do the same by hand, one line for each job, without running them."""


class StudyFailed(WorkFailedError):  # noqa: N818 (a state of the study, as its jobs' failed.json)
    """Some jobs of a study did not succeed."""


def main(args: Args) -> None:
    """Run a study.

    Raises:
        StudyError: The study's file cannot be used.
        InvalidArgumentError: Two settings of a training contradict each other.
        MachineError: The study asks for more than the machine has, or the folder of the jobs cannot be written.
        StudyFailed: Some jobs failed; the others are done.
    """
    study = read_study(args.study)
    jobs = jobs_of(study)
    require_valid_flags(jobs)
    console = Console(width=None if sys.stdout.isatty() else FILE_WIDTH)
    if args.print_commands:
        for job in jobs:
            line = shell_command(job, args.root, study.resources[job.kind])
            console.print(f"# {job.kind}: {job.title}\n{line}", soft_wrap=True, markup=False, highlight=False)
        return
    if args.publish:
        count = publish(jobs, args.root, args.publish, args.name, args.authors)
        left = sum(job.kind == "evaluate" and not is_done(job, args.root) for job in jobs)
        console.print(f"{args.publish} has {count} results; {left} evaluations of {args.study} are not done")
        return
    _require_writable(args.root)
    require_valid_environments(jobs, args.root)
    if args.dry_run:
        console.print(plan(study, jobs, args.root))
        return
    errors = {}
    if not all(is_done(job, args.root) for job in jobs):
        try:
            errors = _run(study, jobs, args.root.absolute(), args.address, console)
        except KeyboardInterrupt:
            done = sum(is_done(job, args.root) for job in jobs)
            log.info(
                "%d of %d jobs are done and kept in %s; the same command goes on with the others", done, len(jobs), args.root
            )
            raise
    failed = [job for job in jobs if not is_done(job, args.root)]
    console.print(f"{len(jobs) - len(failed)} of {len(jobs)} jobs of {args.study} are done, in {args.root}")
    if failed:
        reasons = "\n".join(f"  {job.kind}: {job.title}: {_reason(job, args.root, errors)}" for job in failed)
        raise StudyFailed(f"{len(failed)} jobs are not done; give the same command to try them again:\n{reasons}")


def _require_writable(root: Path) -> None:
    """Try to write into the folder of all jobs before any of them begins."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=root):
            pass
    except OSError as error:
        raise MachineError(f"{root} cannot be written ({error.strerror}); give another --root") from error


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


def _run(study: Study, jobs: list[Job], root: Path, address: str | None, console: Console) -> dict[str, str]:
    """Run every job that is not done, show the progress until none is left, and return the errors by the jobs' keys.

    A job is given to Ray when its resources are free, so that jobs run in the study's order: Ray itself would do all recordings
    first, since these wait for nothing. A job that another study does at present waits until that study has done it or stops.
    """
    _start_ray(address)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C; Ray's own handler prints a stack trace
    restore_child_signals()
    try:
        worker: Any = ray.remote(max_calls=1, max_retries=RETRIES)(perform_in)  # a new process for each job
        _require_resources(study)
        results: dict[str, Any] = {}
        waiting, running = [job for job in jobs if not is_done(job, root)], dict[Any, Job]()
        with Live(console=console, refresh_per_second=1) as live:
            while waiting or running:
                while job := _next_job(study, root, waiting, running):
                    waiting.remove(job)
                    needs = study.resources[job.kind]
                    _await_free(needs)
                    task = worker.options(num_cpus=needs.cpus, num_gpus=needs.gpus, name=job.title)
                    needed = [results[need.key] for need in job.needs if need.key in results]
                    results[job.key] = task.remote(Path.cwd(), job, root, needs, *needed)
                    running[results[job.key]] = job
                if not running and not any(_is_held(job, root) for job in waiting):
                    raise MachineError(
                        f"{study.name}: {len(waiting)} jobs wait, and no machine of the cluster has room for the first of "
                        f"them, {waiting[0].title}; add a machine, and start the study again, which continues"
                    )
                for job in _ended(running):
                    if _is_held(job, root):  # another study was faster
                        waiting.insert(0, job)
                live.update(progress(study, jobs, root))
        if not console.is_terminal:
            console.print()  # rich ends the table's last line in a terminal alone
        return {key: error for key, result in results.items() if (error := _error(result))}
    finally:
        ray.shutdown()


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


def _next_job(study: Study, root: Path, waiting: list[Job], running: dict[Any, Job]) -> Job | None:
    """The first waiting job that can start; None if there is none.

    The jobs that it needs have ended, its resources are free, and no other study does it at present.
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
        if fits and not any(need.key in unfinished for need in job.needs) and not _is_held(job, root):
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


def _reason(job: Job, root: Path, errors: dict[str, str]) -> str:
    """Why a job is not done.

    Args:
        job: The job.
        root: Folder of all jobs.
        errors: What jobs raised, by their keys.
    """
    if not all(is_done(need, root) for need in job.needs):
        return "a job that it needs is not done"
    if failed := read_status(path := job.folder(root) / FAILED):
        return f"{failed['error']} ({path} has the traceback)"
    return errors.get(job.key) or "its worker died"


def progress(study: Study, jobs: list[Job], root: Path) -> Group:
    """A table with the numbers of jobs by their status, and one of the jobs that are running.

    Every status and every cost is read once, because the table is made anew every few seconds while jobs run.
    """
    statuses: dict[str, Status] = {job.key: status_of(job, root) for job in jobs}
    runs = cost.seconds_of_runs(root)
    counts = Table("job", "done", "running", "failed", "all", "CPU hours left")
    kinds: list[Kind] = [kind for kind in KINDS if any(job.kind == kind for job in jobs)]
    for kind in kinds:
        counts.add_row(kind, *_counts([job for job in jobs if job.kind == kind], statuses, runs, study.resources[kind]))
    names = Table("running", "for, min")
    for job in [job for job in jobs if statuses[job.key] == "running"][:SHOWN]:
        since = time.time() - (job.folder(root) / STARTED).stat().st_mtime
        names.add_row(f"{job.kind}: {job.title}", f"{since / 60:.1f}")
    return Group(counts, names)


def _counts(jobs: list[Job], statuses: dict[str, Status], runs: dict[str, float], needs: Resources) -> list[str]:
    """A row of the table of progress.

    Args:
        jobs: The jobs of one kind.
        statuses: Statuses of all jobs, by their keys.
        runs: What jobs cost here (`cost.seconds_of_runs`).
        needs: What the study gives each of the jobs.
    """
    of_kind = Counter(statuses[job.key] for job in jobs)
    left = [job for job in jobs if statuses[job.key] != "done"]
    costs = [cost.estimate_from_runs(job, runs, needs.workers) for job in left]
    hours = "?" if None in costs else f"{sum(one.seconds for one in costs if one) / 3600 * needs.cpus:.2f}"
    return [*map(str, (of_kind["done"], of_kind["running"], of_kind["failed"], len(jobs))), hours]


def plan(study: Study, jobs: list[Job], root: Path) -> Table:
    """A table of the jobs to do and of their hours on this machine; jobs that differ in their seed share a row."""
    table = Table("job", "what", "to do", "CPU hours", "GPU hours", "known from", title=study.name)
    groups: dict[tuple[Kind, str], list[Job]] = {}
    for job in sorted(jobs, key=lambda job: KINDS.index(job.kind)):
        groups.setdefault((job.kind, job.title.partition(", seed")[0]), []).append(job)
    cpu = gpu = 0.0
    for (kind, title), group in track(groups.items(), "measuring", transient=True):
        needs = study.resources[kind]
        costs = [cost.estimate(job, root, needs.workers, gpus=needs.gpus) for job in group if not is_done(job, root)]
        hours = sum(one.seconds for one in costs if one) / 3600
        cpu, gpu = cpu + hours * needs.cpus, gpu + hours * needs.gpus
        source = "done" if not costs else costs[0].source if costs[0] else "not known before the first has run"
        table.add_row(
            kind, title, f"{len(costs)} of {len(group)}", f"{hours * needs.cpus:.2f}", f"{hours * needs.gpus:.2f}", source
        )
    table.add_section()
    table.add_row("", "all jobs that are left whose cost is known", "", f"{cpu:.2f}", f"{gpu:.2f}", "")
    if gpu > 0 and not torch.cuda.is_available():
        table.caption = "These hours follow from trials on the CPU, because this machine has no CUDA GPU."
    return table


def next_step(args: Args, _answer: None) -> str:
    """What the command made, and what one can do with it."""
    study = as_typed("manifeel", "study", args.study, "--root", args.root)
    if args.print_commands:
        return f"these commands do by hand what {study} does"
    if args.dry_run:
        return f"nothing was run; {study} runs what is left"
    if args.publish:
        return f"{args.publish} is a submission; `manifeel leaderboard build` makes the page of the leaderboard"
    page = as_typed("manifeel", "results", "--results", args.root, "--out", "results.md")
    return f"{args.root} has all results; {page} sets them beside the paper's"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
