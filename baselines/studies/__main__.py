"""Run a study: `python -m baselines.studies configs/smoke.yaml`.

Records demonstrations, trains policies on them and evaluates these, for every combination that the study lists, on Ray: on this
machine, or with --address on a cluster whose machines share the folder. What is done is kept under a name made of all that it
depends on, and never done twice; a worker that dies is started again; a study that was stopped goes on.
"""

import logging
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import ray
import tyro
from rich.console import Console, Group
from rich.live import Live
from rich.progress import track
from rich.table import Table

from manifeel_ms3.command_line import run

from . import cost
from .jobs import FAILED, STARTED, is_done, is_running, listen_to_children, perform, read_note
from .study import KINDS, Stage, Study, StudyError, read_study, stages_of

log = logging.getLogger(__name__)
RETRIES = 3
SHOWN = 8  # running stages in the table
RAY_SETTINGS = {  # read by a Ray that is started here
    "RAY_worker_niceness": "0",
    "RAY_kill_child_processes_on_worker_exit_with_raylet_subreaper": "true",  # a killed worker's own processes go with it
}


@dataclass
class Args:
    study: tyro.conf.Positional[Path]
    """yaml; see configs/"""
    root: Path = Path("runs/matrix")
    """folder of all stages, of all studies"""
    address: str | None = None
    """of a Ray cluster; default: this machine"""
    dry_run: bool = False
    """print the plan and what it will cost"""


class StudyFailed(RuntimeError):
    """Some stages did not succeed."""


def main(args: Args) -> None:
    """Run a study.

    Raises:
        StudyError: the study's file cannot be used, or asks for more than the machine has.
        StudyFailed: stages failed; the others are done.
    """
    study = read_study(args.study)
    stages = stages_of(study)
    console = Console()
    if args.dry_run:
        console.print(plan(study, stages, args.root))
        return
    open_stages = [stage for stage in stages if not is_done(stage, args.root)]
    if open_stages:
        _run(study, stages, args.root.absolute(), args.address, console)
    failed = [stage for stage in stages if not is_done(stage, args.root)]
    console.print(f"{len(stages) - len(failed)} of {len(stages)} stages of {args.study} are done, in {args.root}")
    if failed:
        reasons = "\n".join(f"  {stage.kind}: {stage.title}: {_reason(stage, args.root)}" for stage in failed)
        raise StudyFailed(f"{len(failed)} stages are not done; give the same command to try them again:\n{reasons}")


def _run(study: Study, stages: list[Stage], root: Path, address: str | None, console: Console) -> None:
    for name, value in RAY_SETTINGS.items():
        os.environ.setdefault(name, value)
    ray.init(address, include_dashboard=False, log_to_driver=False, logging_level=logging.WARNING, configure_logging=False)
    listen_to_children()
    try:
        worker = ray.remote(max_calls=1, max_retries=RETRIES)(perform)  # a process of its own for each
        _require_resources(study)
        results = {}
        for stage in stages:
            needs = study.resources[stage.kind]
            task = worker.options(num_cpus=needs.cpus, num_gpus=needs.gpus, name=stage.title)
            results[stage.key] = task.remote(stage, root, needs.workers, *(results[need.key] for need in stage.needs))
        waiting = list(results.values())
        with Live(console=console, refresh_per_second=1) as live:
            while waiting:
                _, waiting = ray.wait(waiting, num_returns=len(waiting), timeout=2, fetch_local=False)
                live.update(progress(study, stages, root))
    finally:
        ray.shutdown()


def _require_resources(study: Study) -> None:
    there = ray.cluster_resources()
    for kind, needs in study.resources.items():
        for name, wanted in (("CPU", needs.cpus), ("GPU", needs.gpus)):
            if wanted > there.get(name, 0):
                raise StudyError(
                    f"{study.name}: {kind} needs {wanted:g} {name}s, there are {there.get(name, 0):g}; change `resources`, or "
                    "give the --address of a Ray cluster"
                )


def _reason(stage: Stage, root: Path) -> str:
    if (folder := stage.folder(root) / FAILED).is_file():
        return f"{read_note(folder)['error']} ({folder} has it all)"
    return "its worker died" if (stage.folder(root) / STARTED).is_file() else "what it needs is not done"


def progress(study: Study, stages: list[Stage], root: Path) -> Group:
    """A table of what is done, and one of what is running."""
    counts = Table("stage", "done", "running", "failed", "all", "CPU hours left")
    running = [stage for stage in stages if not is_done(stage, root) and is_running(stage, root)]
    for kind in KINDS:
        alike = [stage for stage in stages if stage.kind == kind]
        done = [stage for stage in alike if is_done(stage, root)]
        failed = [stage for stage in alike if (stage.folder(root) / FAILED).is_file()]
        now = [stage for stage in running if stage.kind == kind]
        needs = study.resources[kind]
        costs = [cost.estimate(stage, root, needs.workers, try_out=False) for stage in alike if stage not in done]
        left = "?" if None in costs else f"{sum(one.seconds for one in costs if one) / 3600 * needs.cpus:.2f}"
        counts.add_row(kind, *map(str, (len(done), len(now), len(failed), len(alike))), left)
    names = Table("running", "for, min")
    for stage in running[:SHOWN]:
        since = time.time() - (stage.folder(root) / STARTED).stat().st_mtime
        names.add_row(f"{stage.kind}: {stage.title}", f"{since / 60:.1f}")
    return Group(counts, names)


def plan(study: Study, stages: list[Stage], root: Path) -> Table:
    """What is to be done, and the hours that it takes on this machine; seeds together."""
    table = Table("stage", "what", "to do", "CPU hours", "GPU hours", "known from", title=study.name)
    alike: dict[tuple[str, str], list[Stage]] = {}
    for stage in stages:
        alike.setdefault((stage.kind, stage.title.partition(", seed")[0]), []).append(stage)
    cpu = gpu = 0.0
    for (kind, title), group in track(alike.items(), "measuring", transient=True):
        needs = study.resources[kind]
        costs = [cost.estimate(stage, root, needs.workers) for stage in group if not is_done(stage, root)]
        hours = sum(one.seconds for one in costs if one) / 3600
        cpu, gpu = cpu + hours * needs.cpus, gpu + hours * needs.gpus
        source = costs[0].source if costs and costs[0] else "done"
        table.add_row(
            kind, title, f"{len(costs)} of {len(group)}", f"{hours * needs.cpus:.2f}", f"{hours * needs.gpus:.2f}", source
        )
    table.add_section()
    table.add_row("", "all that is to do", "", f"{cpu:.2f}", f"{gpu:.2f}", "")
    return table


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
