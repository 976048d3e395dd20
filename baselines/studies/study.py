"""A study: its file in yaml, read and checked."""

import math
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import yaml

from baselines.common.encoders import tacrgb_encoder_names
from baselines.common.policy import PolicyConfig
from baselines.common.train_args import TrainArgs
from baselines.registry import policy_spec
from baselines.tactile_representations.pretrain import Representation
from manifeel_ms3.arguments import one_of, several_of
from manifeel_ms3.errors import InvalidArgumentError, InvalidFileError
from manifeel_ms3.evaluation.variant import SENSING
from manifeel_ms3.files import SHOWN_LENGTH
from manifeel_ms3.tasks.checks import check_argument_names, check_seed
from manifeel_ms3.tasks.obs_modes import in_usual_order, split_obs_mode
from manifeel_ms3.tasks.registry import task_spec, tasks_of_table

Kind = Literal["record", "pretrain", "train", "evaluate"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""Kinds of jobs, in the order in which they need each other."""
SIMULATING: tuple[Kind, ...] = ("record", "evaluate")
"""Kinds of jobs that simulate, in several processes at once."""
OBS_MODE = "rgb+tacrgb+tacff"
"""Observation mode of all recordings, which hold everything that any policy of a study observes."""
OF_THE_STUDY = {
    "env-id": "`tasks`",
    "obs-mode": "`obs_modes`",
    "cameras": "`cameras`",
    "tactile-sensors": "the right pad, which is the only one in its recordings",
    "policy.encoder.tacrgb": "`encoders`",
    "num-demos": "`num_demos`",
    "seed": "`seeds`",
    "keep": "`checkpoints`",
    "demos": "`demos`",
    "eval-episodes": "`episodes`",
    "run-dir": "--root",
    "resume": "the same command again",
    "overwrite": "another --root",
}
"""Flags of `manifeel train` that a study sets itself, and what it takes them from."""
MOST_VALUES = 10_000
"""Largest number of values in a study's file with its aliases expanded; set once, not tuned."""
LEAST = {"demos": 1, "num_demos": 1, "episodes": 1, "checkpoints": 1, "cpus": 0.1, "gpus": 0}
"""Smallest numbers that entries of a grid and of `resources` can have."""
LEAST_SHARE = 0.0001
"""Smallest share of a GPU that Ray can give to a job."""
TABLE = "table "
"""Prefix of `tasks` if it names a table of the paper instead of listing tasks: "table I"."""


class StudyError(InvalidFileError):
    """A study's file cannot be used."""


@dataclass(frozen=True)
class Resources:
    """What each job of a kind occupies while it runs."""

    cpus: float = 1
    """Number of CPU cores."""
    gpus: float = 0
    """Number of GPUs; a fraction where several jobs share one."""

    @property
    def workers(self) -> int:
        """Number of processes that simulate."""
        return max(int(self.cpus), 1)


@dataclass(frozen=True)
class Grid:
    """Lists of choices; every combination of them is recorded, trained and evaluated."""

    tasks: tuple[str, ...]
    """Ids of tasks, or a table of the paper whose tasks are meant: "table I"."""
    obs_modes: tuple[str, ...] = ("rgb", "rgb+tacrgb", "rgb+tacff")
    """Observation modes of the policies."""
    policies: tuple[str, ...] = ("diffusion_policy",)
    """Registered names of policies."""
    encoders: tuple[str, ...] = ("",)
    """Encoders of TacRGB; "" is the preset's. They apply to the observation modes with TacRGB alone."""
    cameras: tuple[str, ...] = ("policy",)
    """Cameras, of which each policy gets one; "policy" is the task's own."""
    num_demos: tuple[int | None, ...] = (None,)
    """Numbers of demonstrations to train on; a task that has fewer is trained on all of its own. null stands for all."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Training seeds."""
    task_args: dict[str, Any] = field(default_factory=dict)
    """Arguments of the tasks that differ from their defaults."""
    evaluation_args: tuple[dict[str, Any], ...] = ({},)
    """Further arguments of the tasks in evaluation alone; every policy is evaluated once with each of these sets."""
    demos: int | None = None
    """Number of demonstrations to record of each task; the paper's number if not given."""
    preset: str = "paper"
    """Preset of training."""
    train: dict[str, Any] = field(default_factory=dict)
    """Further flags of `manifeel train`, such as {steps: 2000, policy.public-code: true}."""
    encoder_flags: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Flags of `manifeel train` that one encoder of TacRGB needs, such as {t3: {tacrgb-weights: weights/t3_medium}}."""
    pretrain: dict[str, str] = field(default_factory=dict)
    """Encoders of TacRGB that are first trained on the paper's number of demonstrations of one task, and the id of that task:
    {unit: ManiFeel-NutBoltAssembly-v1}."""
    episodes: int = 50
    """Number of evaluation episodes of a checkpoint."""
    checkpoints: int = 10
    """Number of checkpoints to evaluate, counted from the last one."""
    stop_at_success: bool = False
    """End evaluation episodes at success or failure, which is cheaper; the results then lack success at the end."""
    half_precision: bool = False
    """Evaluate the checkpoints with their weights rounded to half precision, which is how they can be published."""


@dataclass(frozen=True)
class Study:
    """The content of a study's file."""

    name: str
    """Name of the file, without its ending."""
    grids: tuple[Grid, ...]
    """Grids of all included files and of the file itself."""
    resources: dict[Kind, Resources]
    """Resources of each job, by its kind."""


def read_study(path: Path, _including: tuple[Path, ...] = ()) -> Study:
    """Read a study's file; its key `include` adds the grids of other files.

    Args:
        path: Path of the file.
        _including: The files that include this one.

    Raises:
        StudyError: The file is missing, is not yaml, includes itself, or holds a key, a task or a policy that is not known.
    """
    including = (*_including, path.resolve())
    if path.resolve() in _including:
        raise StudyError(f"{path} includes itself, by way of {[file.name for file in including]}; remove one `include`")
    content = _content(path)
    included = [read_study(path.parent / name, including) for name in content.get("include", [])]
    own = [_grid(entry, f"{path}: grids/{k}") for k, entry in enumerate(content.get("grids", []))]
    grids = [grid for study in included for grid in study.grids] + own
    if not grids:
        raise StudyError(f"{path} has no grids; see configs/ for examples")
    given = content.get("resources", {})
    _require_known(given, set(KINDS), f"{path}: resources")
    asked = {kind: _section(Resources, entry, f"{path}: resources/{kind}") for kind, entry in given.items()}
    asked.setdefault("pretrain", asked.get("train", Resources()))
    resources: dict[Kind, Resources] = {kind: asked.get(kind, Resources()) for kind in KINDS}
    return Study(path.stem, tuple(grids), resources)


def _content(path: Path) -> dict[str, Any]:
    """The file's mapping, with keys of the right kinds."""
    try:
        text = path.read_text(encoding="utf-8")
        if (size := _num_values(yaml.compose(text, yaml.SafeLoader), {})) > MOST_VALUES:
            raise ValueError(f"its aliases and values expand to {size:,} values or more, {MOST_VALUES:,} at most")
        content = yaml.safe_load(text)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())  # yaml's own message has several lines
        raise StudyError(f"{path} cannot be read as a study ({reason}); see configs/ for examples") from error
    if not isinstance(content, dict):
        raise StudyError(f"{path} is not a study: it must be a mapping with the key `grids`; see configs/ for examples")
    _require_known(content, {"grids", "include", "resources"}, f"{path}")
    for name, expected in (("grids", list), ("include", list[str]), ("resources", dict)):
        if name in content and not _is_of(content[name], expected):
            raise StudyError(f"{path}: `{name}` has the wrong type: {_shown(content[name])}; see configs/ for examples")
    return content


def _num_values(node: yaml.Node | None, known: dict[yaml.Node | None, int]) -> int:
    """Number of values of a node with all aliases expanded, which doubles with every level of aliases of aliases.

    Args:
        node: The node; None if the file is empty.
        known: Numbers of the nodes that were counted before; an alias of a node inside itself counts as too many.
    """
    if node not in known:
        known[node] = MOST_VALUES + 1
        inner = node.value if isinstance(node, yaml.CollectionNode) else ()
        parts = (part for item in inner for part in (item if isinstance(item, tuple) else (item,)))
        known[node] = 1 + sum(_num_values(part, known) for part in parts)
    return known[node]


def _shown(value: Any) -> str:
    """A value as an error shows it: only the beginning of a long one."""
    text = repr(value)
    return text if len(text) <= SHOWN_LENGTH else f"{text[:SHOWN_LENGTH]}..."


def _grid(entry: Any, place: str) -> Grid:
    """A grid whose tasks and policies are registered, and whose tasks have the arguments; a table is replaced by its tasks."""
    try:
        if isinstance(entry, dict) and isinstance(tasks := entry.get("tasks"), str):
            entry = entry | dict(tasks=tasks_of_table(tasks.removeprefix(TABLE)) if tasks.startswith(TABLE) else [tasks])
        grid = _section(Grid, entry, place)
        recorded = [grid.demos or task_spec(task).paper_demos for task in grid.tasks]
        for task in grid.pretrain.values():
            task_spec(task)
        for task in grid.tasks:
            names = grid.task_args.keys() | set().union(*grid.evaluation_args)
            check_argument_names(task_spec(task).env_class, names - {"max_episode_steps"})  # which gym.make takes
            if sensing := sorted(names & {*SENSING}):
                raise InvalidArgumentError(f"{sensing} of a task are set by the study itself; use `obs_modes` and `cameras`")
        if any("control_mode" in further for further in grid.evaluation_args):
            raise InvalidArgumentError("evaluation_args: a policy has the control_mode of its demonstrations; use `task_args`")
        for policy in grid.policies:
            one_of(f"preset of {policy}", grid.preset, policy_spec(policy).presets)
        _check_sensing(grid)
        check_seed(grid.seeds)
        train = _train_flags(grid.train, f"{place}: train")
        of_encoders = {
            name: _train_flags(flags, f"{place}: encoder_flags/{name}") for name, flags in grid.encoder_flags.items()
        }
    except InvalidArgumentError as error:
        raise StudyError(f"{place}: {error}") from error
    if unknown := set(grid.pretrain) - set(get_args(Representation)):
        raise StudyError(f"{place}: pretrain {sorted(unknown)} cannot be pretrained; choose from {get_args(Representation)}")
    _check_encoders(grid, place)
    if too_many := [count for count in grid.num_demos if count and count > max(recorded, default=0)]:
        raise StudyError(f"{place}: num_demos {too_many} are more than the {max(recorded)} recorded; raise `demos`")
    return replace(  # with one spelling of everything, so that the same run is the same job however it is written
        grid,
        tasks=tuple(task_spec(task).env_id for task in grid.tasks),
        obs_modes=tuple(map(in_usual_order, grid.obs_modes)),
        pretrain={encoder: task_spec(task).env_id for encoder, task in grid.pretrain.items()},
        train=train,
        encoder_flags=of_encoders,
    )


def _check_encoders(grid: Grid, place: str) -> None:
    """Check that what is given for encoders is given for those of the grid.

    Raises:
        StudyError: It is not.
    """
    if unused := (set(grid.encoder_flags) | set(grid.pretrain)) - set(grid.encoders):
        raise StudyError(f"{place}: encoder_flags and pretrain name {sorted(unused)}; `encoders` are {list(grid.encoders)}")


def _check_sensing(grid: Grid) -> None:
    """Check the names of what the policies observe, and of the encoders of TacRGB."""
    for task in grid.tasks:
        several_of("cameras", grid.cameras, ("policy", *task_spec(task).env_class.known_cameras()))
    several_of("encoders", grid.encoders, ("", *tacrgb_encoder_names()))
    for mode in grid.obs_modes:
        split_obs_mode(mode)
        several_of(f"obs_modes: a part of {mode!r}", mode.split("+"), OBS_MODE.split("+"))


def _train_flags(given: dict[str, Any], place: str) -> dict[str, Any]:
    """Flags of `manifeel train` with one spelling each, so that the same run is the same job however its flags are written.

    Raises:
        StudyError: A flag is given twice, or is one that the study sets itself.
    """
    flags: dict[str, Any] = {}
    for name, value in given.items():
        spelt = name.replace("_", "-")
        spelt = _short_names().get(spelt, spelt)
        if spelt in OF_THE_STUDY:
            raise StudyError(f"{place}: {name!r} is set by the study itself; leave it out, and use {OF_THE_STUDY[spelt]}")
        if spelt in flags:
            raise StudyError(f"{place}: {name!r} is given twice, since {spelt!r} is the same flag; leave one out")
        flags[spelt] = value
    return flags


@cache
def _short_names() -> dict[str, str]:
    """Second names of the flags of `manifeel train` that have two, by the first."""
    names = {}
    for prefix, kind in (("", TrainArgs), ("policy.", PolicyConfig)):
        for name, hint in get_type_hints(kind, include_extras=True).items():
            for flag in getattr(hint, "__metadata__", ()):
                if flag.aliases:
                    names[prefix + (flag.name or name).replace("_", "-")] = flag.aliases[0].removeprefix("--")
    return names


def _section(kind: type, entry: Any, place: str) -> Any:
    """One of the dataclasses above, from a mapping of its fields."""
    if not isinstance(entry, dict):
        raise StudyError(f"{place} must be a mapping, not {_shown(entry)}")
    types = {item.name: item.type for item in fields(kind)}
    _require_known(entry, set(types), place)
    for name, value in entry.items():
        if not _is_of(value, types[name]):
            raise StudyError(f"{place}: `{name}` has the wrong type: {_shown(value)}; see configs/ for examples")
        numbers = value if isinstance(value, list) else [value]
        if not numbers:
            raise StudyError(f"{place}: `{name}` is empty, so that there would be no job; leave it out, or list a choice")
        least = LEAST.get(name, -math.inf)
        if wrong := [x for x in numbers if name in LEAST and x is not None and not least <= x < math.inf]:
            raise StudyError(f"{place}: `{name}` is {_shown(wrong[0])}; at least {least} is needed, and not infinity")
        if odd := [x for x in numbers if name == "gpus" and not (x == int(x) or LEAST_SHARE <= x < 1)]:
            raise StudyError(f"{place}: `gpus` is {odd[0]}; give a whole number, or a share of one GPU from {LEAST_SHARE} on")
    try:
        return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in entry.items()})
    except TypeError as error:
        raise StudyError(f"{place}: {error}") from error


def _is_of(value: Any, annotation: Any) -> bool:
    """Whether a value from yaml is of an annotated type; a list stands for a tuple."""
    inner = get_args(annotation)
    if get_origin(annotation) in (tuple, list):
        return isinstance(value, list) and all(_is_of(item, inner[0]) for item in value)
    if get_origin(annotation) is dict:
        return isinstance(value, dict) and all(isinstance(key, str) and _is_of(item, inner[1]) for key, item in value.items())
    if annotation is Any:  # yaml also knows dates, bytes and sets, which no argument takes
        if isinstance(value, list | dict):
            return _is_of(value, list[Any] if isinstance(value, list) else dict[str, Any])
        return value is None or isinstance(value, int | float | str)
    if isinstance(value, bool):  # which is an int, too
        return annotation is bool
    return isinstance(value, int | float if annotation is float else annotation)


def _require_known(entry: dict[Any, Any], known: set[str], place: str) -> None:
    if unknown := set(entry) - known:
        raise StudyError(f"{place}: {sorted(map(str, unknown))} are not known; choose from {sorted(known)}")
