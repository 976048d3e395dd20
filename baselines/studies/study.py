"""What is to be run: studies from yaml, and the stages that they come to."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import cached_property
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any, Literal

import yaml

from baselines.registry import policy_spec
from manifeel_ms3.command_line import PACKAGE
from manifeel_ms3.errors import InvalidFileError, UnknownNameError
from manifeel_ms3.tasks.registry import short_name, task_spec

Kind = Literal["record", "train", "evaluate"]
KINDS: tuple[Kind, ...] = ("record", "train", "evaluate")


class StudyError(InvalidFileError):
    """A study's file that cannot be used."""


@dataclass(frozen=True)
class Resources:
    cpus: float = 1
    gpus: float = 0

    @property
    def workers(self) -> int:
        """Processes that simulate."""
        return max(int(self.cpus), 1)


@dataclass(frozen=True)
class Grid:
    """Every combination of its lists is a set-up."""

    tasks: tuple[str, ...]
    obs_modes: tuple[str, ...] = ("rgb", "rgb+tacrgb", "rgb+tacff")
    policies: tuple[str, ...] = ("diffusion_policy",)
    """Registered names of policies."""
    encoders: tuple[str, ...] = ("",)
    """of TacRGB; "" is the preset's"""
    cameras: tuple[str, ...] = ("policy",)
    """one each; "policy" is the task's own"""
    num_demos: tuple[int | None, ...] = (None,)
    """demonstrations trained on; null: all"""
    seeds: tuple[int, ...] = (0, 1, 2)
    task_args: dict[str, Any] = field(default_factory=dict)
    """arguments of the tasks other than their defaults"""
    demos: int | None = None
    """demonstrations recorded; null: the paper's number, or as many as are trained on"""
    preset: str = "paper"
    train: dict[str, Any] = field(default_factory=dict)
    """further flags of train.py, such as {steps: 2000, policy.down-dims: [64, 128]}"""
    encoder_flags: dict[str, dict[str, Any]] = field(default_factory=dict)
    """flags that come with an encoder of TacRGB, such as {t3: {image-size: 224}}"""
    episodes: int = 50
    """starts evaluated"""
    checkpoints: int = 10
    """the last so many are evaluated"""


@dataclass(frozen=True)
class Study:
    name: str
    grids: tuple[Grid, ...]
    resources: dict[Kind, Resources]


@dataclass(frozen=True)
class Stage:
    """A piece of work with a folder of its own, named by everything that it depends on."""

    kind: Kind
    title: str
    settings: dict[str, Any]
    """all that its work depends on, but for what it needs"""
    needs: tuple["Stage", ...] = ()

    @cached_property
    def key(self) -> str:
        content = json.dumps([self.kind, self.settings, [stage.key for stage in self.needs]], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def folder(self, root: Path) -> Path:
        return root / self.kind / self.key


def read_study(path: Path) -> Study:
    """A study's file; `include` adds the grids of others.

    Raises:
        StudyError: it is missing, no yaml, or has something in it that is not known.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError) as error:
        raise StudyError(f"{path} cannot be read as a study ({error}); see configs/ for some") from error
    if not isinstance(content, dict):
        raise StudyError(f"{path} is no study: it must hold `grids:`; see configs/ for some")
    _require_known(content, {"grids", "include", "resources"}, f"{path}")
    included = [read_study(path.parent / name) for name in content.get("include", [])]
    grids = [_made(Grid, entry, f"{path}: grids/{k}") for k, entry in enumerate(content.get("grids", []))]
    grids = [grid for study in included for grid in study.grids] + grids
    if not grids:
        raise StudyError(f"{path} has no grids; see configs/ for some")
    given = content.get("resources", {})
    _require_known(given, set(KINDS), f"{path}: resources")
    resources = {kind: _made(Resources, given.get(kind, {}), f"{path}: resources/{kind}") for kind in KINDS}
    for k, grid in enumerate(grids):
        _require_registered(grid, f"{path}: grids/{k}")
    return Study(path.stem, tuple(grids), resources)


def _require_registered(grid: Grid, place: str) -> None:
    try:
        for task in grid.tasks:
            task_spec(task)
        for policy in grid.policies:
            policy_spec(policy)
    except UnknownNameError as error:
        raise StudyError(f"{place}: {error}") from error


def _made(kind: type, entry: Any, place: str) -> Any:
    if not isinstance(entry, dict):
        raise StudyError(f"{place} must be a mapping, not {entry!r}")
    _require_known(entry, {item.name for item in fields(kind)}, place)
    try:
        return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in entry.items()})
    except TypeError as error:
        raise StudyError(f"{place}: {error}") from error


def _require_known(entry: dict, known: set[str], place: str) -> None:
    if unknown := set(entry) - known:
        raise StudyError(f"{place}: {sorted(unknown)} are not known; choose from {sorted(known)}")


def stages_of(study: Study) -> list[Stage]:
    """Every stage once, each after what it needs."""
    stages: dict[str, Stage] = {}
    for grid in study.grids:
        for evaluate in _evaluations(grid):
            (train,) = evaluate.needs
            for stage in (*train.needs, train, evaluate):
                stages.setdefault(stage.key, stage)
    return sorted(stages.values(), key=lambda stage: KINDS.index(stage.kind))


def _evaluations(grid: Grid) -> Iterator[Stage]:
    """One a trained policy."""
    choices = (grid.tasks, grid.policies, grid.obs_modes, grid.encoders, grid.cameras, grid.num_demos, grid.seeds)
    for task, policy, mode, encoder, camera, num_demos, seed in product(*choices):
        if encoder and "tacrgb" not in mode.split("+"):
            continue
        camera = task_spec(task).policy_camera if camera == "policy" else camera
        train = _training(grid, _recording(grid, task, camera), policy, mode, encoder, num_demos, seed)
        wanted = dict(env_id=task, episodes=grid.episodes, checkpoints=grid.checkpoints)
        wanted |= dict(env_kwargs=_env_kwargs(grid), version=version(PACKAGE))
        yield Stage("evaluate", train.title, wanted, (train,))


def _recording(grid: Grid, task: str, camera: str) -> Stage:
    trained_on = max((count for count in grid.num_demos if count), default=0)
    count = grid.demos or max(task_spec(task).paper_demos, trained_on)
    settings = dict(env_id=task, num=count, camera=camera, env_kwargs=_env_kwargs(grid))
    settings |= dict(revision=task_spec(task).revision)
    return Stage("record", f"{short_name(task)}, {count} demonstrations, {camera}", settings)


def _training(grid: Grid, record: Stage, policy: str, mode: str, encoder: str, num_demos: int | None, seed: int) -> Stage:
    task, camera = record.settings["env_id"], record.settings["camera"]
    flags = {"env-id": task, "obs-mode": mode, "cameras": camera, "seed": seed, "keep": grid.checkpoints} | grid.train
    if num_demos is not None:
        flags["num-demos"] = num_demos
    if encoder:
        flags |= {"policy.encoder.tacrgb": encoder} | grid.encoder_flags.get(encoder, {})
    demonstrations = f"{num_demos} demonstrations" if num_demos else ""
    title = ", ".join(filter(None, (short_name(task), policy, mode, encoder, camera, demonstrations, f"seed {seed}")))
    settings = dict(policy=policy, preset=grid.preset, flags=flags, version=version(PACKAGE))
    return Stage("train", title, settings, (record,))


def _env_kwargs(grid: Grid) -> str:
    return json.dumps(grid.task_args, sort_keys=True)
