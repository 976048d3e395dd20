"""The jobs that the grids of a study stand for."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

from baselines.registry import policy_spec
from manifeel_ms3.analysis.condition import listed, study_row
from manifeel_ms3.arguments import meant
from manifeel_ms3.command_line import PACKAGE
from manifeel_ms3.errors import UnknownNameError
from manifeel_ms3.nested_settings import as_json
from manifeel_ms3.tasks.registry import short_name, task_spec

from .study import Grid, Kind, Study

OF_THE_MACHINE = ("device", "precision", "compile")
"""Settings of a preset that depend on the machine on which it is read."""
SEED = ", seed "
"""What stands before the training seed in the title of a job."""


@dataclass(frozen=True)
class Job:
    """One recording, one pretraining of an encoder, one training run or one evaluation.

    Its folder is named by everything that it depends on.
    """

    kind: Kind
    """Kind of the job."""
    title: str
    """Description of the job, for people."""
    settings: dict[str, Any]
    """Everything that the job's outcome depends on, apart from the jobs in `needs`."""
    needs: tuple["Job", ...] = ()
    """Jobs whose output this one reads."""

    @cached_property
    def key(self) -> str:
        """Hash of everything that the job depends on."""
        content = json.dumps([self.kind, self.settings, [job.key for job in self.needs]], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    @property
    def row(self) -> str:
        """Name of the job's row in the plan, which it shares with the jobs that differ from it in their seed."""
        return self.title.partition(SEED)[0]

    def folder(self, root: Path) -> Path:
        """Folder of the job's output and of the files that hold its status."""
        return root / self.kind / self.key


def jobs_of(study: Study) -> list[Job]:
    """Every job of a study once, in the order of its grids; each stands after the jobs that it needs."""
    jobs: dict[str, Job] = {}
    for grid in study.grids:
        for evaluate in _evaluations(grid):
            for job in _with_needs(evaluate):
                jobs.setdefault(job.key, job)
    return list(jobs.values())


def only(jobs: list[Job], rows: Sequence[str]) -> list[Job]:
    """The jobs of some rows of a plan, and those that they need.

    Args:
        jobs: All jobs of a study.
        rows: Names of rows.

    Raises:
        UnknownNameError: The study has no row of one of these names.
    """
    known = {job.row for job in jobs}
    for row in rows:
        if row not in known:
            raise UnknownNameError(f"no row of the study is named {row!r}{meant(row, known)}; --dry-run lists all rows")
    needed = {job.key for chosen in jobs if chosen.row in rows for job in _with_needs(chosen)}
    return [job for job in jobs if job.key in needed]


def _with_needs(job: Job) -> Iterator[Job]:
    """A job after all those that it needs."""
    for need in job.needs:
        yield from _with_needs(need)
    yield job


def _evaluations(grid: Grid) -> Iterator[Job]:
    """The evaluations of each policy that the grid trains."""
    choices = (grid.tasks, grid.policies, grid.obs_modes, grid.encoders, grid.cameras, grid.num_demos, grid.seeds)
    for task, policy, mode, encoder, camera, num_demos, seed in product(*choices):
        if encoder and "tacrgb" not in mode.split("+"):
            continue
        camera = task_spec(task).policy_camera if camera == "policy" else camera
        record = _recording(task, grid.demos or task_spec(task).paper_demos, camera, json.dumps(grid.task_args, sort_keys=True))
        train = _training(grid, record, policy, mode, encoder, num_demos, seed)
        settings = dict(env_id=task, episodes=grid.episodes, checkpoints=grid.checkpoints, stop_at_success=grid.stop_at_success)
        settings["half_precision"] = grid.half_precision
        for further in grid.evaluation_args:
            env_kwargs = json.dumps(grid.task_args | further, sort_keys=True)
            title = listed(train.title, json.dumps(further) if further else "")
            yield Job("evaluate", title, settings | dict(env_kwargs=env_kwargs, version=version(PACKAGE)), (train,))


def _recording(task: str, count: int, camera: str, env_kwargs: str) -> Job:
    settings = dict(env_id=task, num=count, camera=camera, env_kwargs=env_kwargs, revision=task_spec(task).revision)
    return Job("record", listed(short_name(task), _variant(env_kwargs), camera, f"{count} demonstrations"), settings)


def _variant(env_kwargs: str) -> str:
    """Arguments of a task as json, or "" if there are none."""
    return "" if env_kwargs == "{}" else env_kwargs


def _pretraining(encoder: str, task: str) -> Job:
    """The training of an encoder of TacRGB on the recording that Table I needs anyway."""
    record = _recording(task, task_spec(task).paper_demos, task_spec(task).policy_camera, "{}")
    settings = dict(encoder=encoder, version=version(PACKAGE))
    return Job("pretrain", f"{encoder} on {short_name(task)}", settings, (record,))


def _training(grid: Grid, record: Job, policy: str, mode: str, encoder: str, num_demos: int | None, seed: int) -> Job:
    task, camera = record.settings["env_id"], record.settings["camera"]
    flags = {"env-id": task, "obs-mode": mode, "cameras": camera, "seed": seed, "keep": grid.checkpoints} | grid.train
    some = num_demos is not None and num_demos < record.settings["num"]
    if some:
        flags["num-demos"] = num_demos
    if encoder:
        flags |= {"policy.encoder.tacrgb": encoder} | grid.encoder_flags.get(encoder, {})
    count = num_demos if some else record.settings["num"]
    variant = _variant(record.settings["env_kwargs"])
    row = study_row(short_name(task), variant, policy, grid.preset, mode, encoder, camera, count)
    recipe = _hash_of_preset(policy, grid.preset)
    settings = dict(policy=policy, preset=grid.preset, recipe=recipe, flags=flags, version=version(PACKAGE))
    pretrained = (_pretraining(encoder, grid.pretrain[encoder]),) if encoder in grid.pretrain else ()
    return Job("train", f"{row}{SEED}{seed}", settings, (record, *pretrained))


@cache
def _hash_of_preset(policy: str, preset: str) -> str:
    """Hash of a preset's settings, so that a run that was made before the preset changed counts as another run."""
    args = as_json(policy_spec(policy).presets[preset].args)
    settings = {name: value for name, value in args.items() if name not in OF_THE_MACHINE}
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
