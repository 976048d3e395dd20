"""Run a study: `manifeel study configs/smoke.yaml`.

A study records demonstrations, trains policies on them and evaluates these policies, for every combination that its file
lists. It runs on Ray: on this machine, or with `--address` on a cluster whose machines share the folder. Each job's output is
kept in a folder that is named by everything the job depends on, and no job is done twice. A worker that dies is started
again, and a study that was stopped goes on where it stopped.
"""

import logging
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

import torch
import tyro
from rich.console import Console, Group
from rich.live import Live
from rich.progress import track
from rich.table import Table

from manifeel_ms3.command_line import as_typed, run
from manifeel_ms3.errors import MachineError, WorkFailedError

from . import cost
from .checks import require_devices, require_valid_environments, require_valid_flags
from .command_lines import shell_command
from .jobs import FAILED, STARTED, Status, is_done, read_status, status_of
from .planning import Job, jobs_of, only
from .publish import publish
from .running import run_jobs
from .study import KINDS, Kind, Resources, Study, read_study

log = logging.getLogger(__name__)
SHOWN = 8
"""Largest number of running jobs in the table; set once, not tuned."""
FILE_WIDTH = 160
"""Number of characters of a line if the output is not a terminal; wide enough for the tables."""


@dataclass
class Args:
    """Arguments of `manifeel study`."""

    study: tyro.conf.Positional[Path]
    """Path of the study's file in yaml; `configs/` has examples."""
    root: Path = Path("runs/study")
    """Folder of the output of all jobs. Studies can share it: a job that two studies have in common is done once."""
    address: str | None = None
    """Address of a Ray cluster; this machine if not given."""
    only: tuple[str, ...] = ()
    """Names of rows of the plan, as `--dry-run` prints them, such as "PegInsertion, diffusion_policy, cpu, rgb, wrist, 50
    demonstrations": only their jobs are done, and those that they need. All rows if not given."""
    dry_run: bool = False
    """Print the plan and the hours that it will take, without running it."""
    publish: Path | None = None
    """Folder of a submission on the leaderboard, such as leaderboard/cpu, into which the results that are done are copied, with
    the checkpoints of training seed 0; nothing is run. Other results of the folder stay. Only evaluations with
    `half_precision: true` are copied."""
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
        UnknownNameError: The study has no row of one of the names in `only`.
        InvalidArgumentError: Two settings of a training contradict each other.
        MachineError: The study asks for more than the machine has, or the folder of the jobs cannot be written.
        StudyFailed: Some jobs failed; the others are done.
    """
    study = read_study(args.study)
    jobs = jobs_of(study)
    jobs = only(jobs, args.only) if args.only else jobs
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
    if args.address is None:
        require_devices(jobs, args.root)
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


def _run(study: Study, jobs: list[Job], root: Path, address: str | None, console: Console) -> dict[str, str]:
    """Run every job that is not done, show the progress until none is left, and return the errors by the jobs' keys."""
    with Live(console=console, refresh_per_second=1) as live:
        errors = run_jobs(study, jobs, root, address, lambda: live.update(progress(study, jobs, root)))
    if not console.is_terminal:
        console.print()  # rich ends the table's last line in a terminal alone
    return errors


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
    costs = [cost.estimate_from_runs(job, runs, needs.workers, needs.gpus) for job in left]
    hours = "?" if None in costs else f"{sum(one.seconds for one in costs if one) / 3600 * needs.cpus:.2f}"
    return [*map(str, (of_kind["done"], of_kind["running"], of_kind["failed"], len(jobs))), hours]


def plan(study: Study, jobs: list[Job], root: Path) -> Table:
    """A table of the jobs to do and of their hours on this machine.

    Jobs that differ in their seed, or in the arguments of their evaluation, share a row; it names the source of the first cost.
    """
    table = Table("job", "what", "to do", "CPU hours", "GPU hours", "known from", title=study.name)
    groups: dict[tuple[Kind, str], list[Job]] = {}
    for job in sorted(jobs, key=lambda job: KINDS.index(job.kind)):
        groups.setdefault((job.kind, job.row), []).append(job)
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
