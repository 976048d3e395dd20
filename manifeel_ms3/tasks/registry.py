"""The registry of all tasks: one `TaskSpec` per task holds all that this package says of it.

A task registers itself with one decorator, which also makes its id known to `gym.make`:

    @register_task("MyTask-v1", category="insertion", max_episode_steps=300, paper_demos=50)
    class MyTaskEnv(VisuotactileEnv): ...

Recording, training, evaluation, studies, the leaderboard and the documentation ask this registry. Other modules attach parts to
a task: its demonstrator (`register_demonstrator`), and questions of the information audit (`register_probe`). Another package's
tasks are found through the entry point group `manifeel.tasks`.
"""

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

import gymnasium as gym
from mani_skill.utils.registration import register_env

from manifeel_ms3 import plugins
from manifeel_ms3.arguments import is_number, meant
from manifeel_ms3.errors import InvalidArgumentError, ManifeelError, PluginError, UnknownNameError
from manifeel_ms3.typed_modules import MODULES

Class = TypeVar("Class", bound=type)
Demonstrator = TypeVar("Demonstrator", bound=Callable[..., Any])
FIRST_EVALUATION_SEED = 100_000
"""Episodes from this seed on are for evaluation, as in the paper's public code; demonstrations use the seeds below it."""
DESCRIPTION = "**Task Description:**"
"""Heading of the description in the docstring of a task's class."""
PREFIX, SUFFIX = "ManiFeel-", "-v1"
"""What the id of one of this package's tasks has before and after its short name."""


@dataclass
class TaskSpec:
    """All that this package says of one task."""

    env_id: str
    """Id for `gym.make`, such as "ManiFeel-PegInsertion-v1"."""
    env_class: Any
    """The environment's class, a `VisuotactileEnv`."""
    category: str
    """Category of the paper: "insertion", "screwing" or "exploration"."""
    max_episode_steps: int
    """Time limit of an episode, in control steps: at least twice the mean length of the paper's number of demonstrations, and
    1.5 times that of the longest of them."""
    paper_demos: int
    """Number of demonstrations that the paper recorded, as does `manifeel dataset`; its Table I trains on 50 at most."""
    instruction: str = ""
    """The task as one plain English sentence that tells a robot what to do, for policies that take language; "" if none."""
    goal_instructions: Mapping[str, str] = field(default_factory=dict)
    """Such sentences for the values of the task's argument `goal` that change what is to be done."""
    start_control_modes: Mapping[str, str] = field(default_factory=dict)
    """Control modes of the values of the task's argument `start` that have another one than the task's own."""
    paper_tables: tuple[str, ...] = ()
    """Tables of the paper that report the task: "I", "II", "III"."""
    revision: int = 1
    """Number of the task's version, raised whenever its outcomes change; results of different revisions cannot be compared."""
    demo_megabytes: float = 15.0
    """Size of one demonstration with every observation, in MB, rounded up, by which free disk space is checked."""
    force_limit: float | None = None
    """Largest contact force of a gentle success, in N: twice the median of the demonstrations' largest forces; None if not
    known."""
    demo_steps: float | None = None
    """Mean number of control steps of a demonstration, over the seeds that docs/tasks.md names; None if not known."""
    demonstrator: Callable[[Any, int], Any] | None = None
    """Makes a scripted demonstrator from an environment and a seed; attached by `register_demonstrator`."""
    probes: list[Any] = field(default_factory=list)
    """Questions that the information audit asks of the task; attached by `manifeel_ms3.analysis.probes.register_probe`."""

    def instruction_for(self, env_kwargs: Mapping[str, Any]) -> str:
        """The sentence for the task with these arguments; "" if there is none."""
        return self.goal_instructions.get(str(env_kwargs.get("goal")), self.instruction)

    def control_mode(self, env_kwargs: Mapping[str, Any]) -> str:
        """The control mode of the task with these arguments."""
        own = self.start_control_modes.get(str(env_kwargs.get("start")), self.env_class.default_control_mode)
        return env_kwargs.get("control_mode") or own

    @property
    def name(self) -> str:
        """Short name, such as "PegInsertion"."""
        return short_name(self.env_id)

    @property
    def gym_id(self) -> str:
        """Id with the module that gymnasium imports first, such as "manifeel_ms3:ManiFeel-PegInsertion-v1"."""
        return gym_id(self.env_id, self.env_class)

    @property
    def policy_camera(self) -> str:
        """Camera that the paper's policies look through."""
        return self.env_class.policy_cameras[0]


_SPECS: dict[str, TaskSpec] = {}
REQUIRED = ("category", "paper_demos")
"""Fields that every task gives, beside its id and its time limit."""
COUNTS = ("max_episode_steps", "paper_demos", "revision")
"""Fields of a task that are whole numbers."""


def register_task(env_id: str, *, max_episode_steps: int, **about: Any) -> Callable[[Class], Class]:
    """Class decorator that registers a task here, with ManiSkill and with gymnasium.

    Args:
        env_id: Id for `gym.make`; it must end in a version, such as "-v1".
        max_episode_steps: Time limit of an episode, in control steps.
        about: The other fields of `TaskSpec`.

    Raises:
        PluginError: Another class has registered the id, a field is missing, or the id or a field is not allowed.
    """
    if not re.fullmatch(r"[\w.-]+-v\d+", env_id):
        raise PluginError(f"the id {env_id!r} of a task must end in a version; give one such as 'MyLab-Press-v1'")
    known_fields = [known.name for known in fields(TaskSpec)[1:]]
    if unknown := sorted(about.keys() - known_fields):
        raise PluginError(f"the task {env_id!r} is registered with {unknown}; the fields of a task are {known_fields}")
    if missing := [name for name in REQUIRED if name not in about]:
        raise PluginError(f"the task {env_id!r} is registered without {missing}; give `register_task` these, too")
    for name, number in (dict(max_episode_steps=max_episode_steps) | about).items():
        if name in COUNTS and not (isinstance(number, int) and number >= 1):
            raise PluginError(f"the task {env_id!r} has {name}={number!r}; give a whole number of at least 1")

    def register(env_class: Class) -> Class:
        known = _SPECS.get(env_id)
        if known and _qualified(known.env_class) != _qualified(env_class):
            raise PluginError(
                f"the task {env_id!r} is registered twice, by {_qualified(known.env_class)} and by {_qualified(env_class)}; "
                f"give one of them another id. Registered are {list(_SPECS)}"
            )
        register_env(env_id, max_episode_steps=max_episode_steps, override=known is not None)(env_class)
        # ManiSkill's entry point works only in processes that have imported the task, and those that gymnasium spawns have not;
        # the name of the class makes gymnasium import it
        gym.registry[env_id].entry_point = f"{env_class.__module__}:{env_class.__qualname__}"
        _SPECS[env_id] = TaskSpec(env_id, env_class, max_episode_steps=max_episode_steps, **about)
        return env_class

    return register


def register_demonstrator(*env_ids: str) -> Callable[[Demonstrator], Demonstrator]:
    """Decorator that makes a class, or a function, the scripted demonstrator of tasks that are registered already.

    Raises:
        UnknownNameError: A task is not registered.
        PluginError: A task has a demonstrator of another class.
    """

    def attach(expert_class: Demonstrator) -> Demonstrator:
        for env_id in env_ids:
            spec = _known(env_id)
            if spec.demonstrator is not None and _qualified(spec.demonstrator) != _qualified(expert_class):
                raise PluginError(f"{env_id!r} has the demonstrator {_qualified(spec.demonstrator)} already")
            spec.demonstrator = expert_class
        return expert_class

    return attach


def other_revision(env_id: str, revision: int | None, subject: str = "it is") -> str:
    """The beginning of an error about what was made of another revision of a task than the present one; "" if it was not.

    Args:
        env_id: Id of the task.
        revision: Revision of the task at that time; None if that is not known, which passes.
        subject: Subject and verb of the sentence.

    Raises:
        UnknownNameError: The task is not registered.
    """
    here = task_spec(env_id).revision
    if revision in (None, here):
        return ""
    return f"{subject} of revision {revision} of {env_id}, but the task has revision {here} here"


def task_spec(env_id: str) -> TaskSpec:
    """The specification of a task.

    Args:
        env_id: Id of the task, or its short name, such as "PegInsertion". A module before a colon, as in the id of ManiSkill's
            files ("manifeel_ms3:ManiFeel-PegInsertion-v1"), is ignored, and never imported.

    Raises:
        UnknownNameError: The task is not registered; the message lists those that are.
    """
    _load_plugins()
    name = env_id.rpartition(":")[2]
    return _known(next((known for known in _SPECS if short_name(known) == name), name))


def instruction_of(env_class: type) -> str:
    """The instruction of the task that a class, or the nearest of its base classes, was registered for; "" if none was."""
    sentences = {spec.env_class: spec.instruction for spec in _SPECS.values()}
    return next((sentences[one] for one in env_class.__mro__ if one in sentences), "")


def description_of(env_class: type) -> str:
    """The documentation of a task's class; if it only says how it differs from its base class, that of the base class, too."""
    documented = [inspect.cleandoc(base.__doc__ or "") for base in env_class.__mro__]
    described = (k for k, said in enumerate(documented) if DESCRIPTION in said)
    return "\n\n".join(documented[: next(described, 0) + 1])


def make_env(env_id: str, /, **kwargs: Any) -> gym.Env:
    """Make a task's environment, as `gym.make` does, also in a process that has not loaded the tasks of other packages.

    Args:
        env_id: Id of the task, with or without a module before a colon.
        kwargs: Arguments of the environment, which often come from a file.

    Raises:
        UnknownNameError: The task is not registered; the message lists those that are.
        InvalidArgumentError: The environment cannot be made with the arguments.
        MachineError: The machine lacks what the environment needs.
    """
    spec = task_spec(env_id)
    limit = kwargs.get("max_episode_steps", 1)
    if is_number(limit) and limit < 1:  # gymnasium takes -1, ManiSkill then ends at once
        raise InvalidArgumentError(f"max_episode_steps={limit} must be at least 1; leave it out for the task's own limit")
    try:
        return gym.make(spec.env_id, **kwargs)
    except ManifeelError:
        raise
    except Exception as error:  # ManiSkill and SAPIEN raise errors of many types for arguments that they pass on
        said = str(error).partition(" was raised from the environment creator")[0]  # gymnasium adds the arguments
        raise InvalidArgumentError(
            f"{spec.env_id} cannot be made with the arguments {kwargs} ({type(error).__name__}: {said}); change one of them"
        ) from error


def all_tasks() -> dict[str, TaskSpec]:
    """The specifications of all registered tasks by their ids: this package's in the paper's order, then those of plug-ins."""
    _load_plugins()
    return dict(_SPECS)


def tasks_of_table(table: str) -> list[str]:
    """Ids of the tasks that a table of the paper ("I", "II" or "III") reports.

    Raises:
        UnknownNameError: The paper has no such table.
    """
    found = [env_id for env_id, spec in all_tasks().items() if table in spec.paper_tables]
    if not found:
        known = sorted({name for spec in _SPECS.values() for name in spec.paper_tables})
        raise UnknownNameError(f"no task is in table {table!r} of the paper; its tables are {known}")
    return found


def evaluation_seeds(count: int) -> list[int]:
    """Seeds of the first `count` evaluation episodes, the same for every task.

    Raises:
        InvalidArgumentError: `count` is less than 1.
    """
    if count < 1:
        raise InvalidArgumentError(f"{count} evaluation episodes are asked for; at least 1 is needed")
    return list(range(FIRST_EVALUATION_SEED, FIRST_EVALUATION_SEED + count))


def gym_id(env_id: str, env_class: type) -> str:
    """Id with the module that gymnasium imports first, such as "manifeel_ms3:ManiFeel-PegInsertion-v1"."""
    package, module = __name__.partition(".")[0], env_class.__module__
    return f"{package if module.startswith(f'{package}.') else module}:{env_id}"


def short_name(env_id: str) -> str:
    """Short name of a task: "PegInsertion" for "ManiFeel-PegInsertion-v1"."""
    return env_id.removeprefix(PREFIX).removesuffix(SUFFIX)


def full_id(name: str) -> str:
    """Id of one of this package's tasks: "ManiFeel-PegInsertion-v1" for "PegInsertion"."""
    return f"{PREFIX}{name}{SUFFIX}"


def _known(env_id: str) -> TaskSpec:
    if env_id not in _SPECS:
        known = f"registered are {list(_SPECS)}{meant(short_name(env_id), map(short_name, _SPECS))}{_left_out()}"
        own = f"; {MODULES}=MODULE before a command names the module of a task that is not installed"
        raise UnknownNameError(f"the task {env_id!r} is not registered; {known}{own if known.endswith(']') else ''}")
    return _SPECS[env_id]


def _load_plugins() -> list[str]:
    """Import the task modules of other packages, and return the names of the broken ones, which are left out."""
    return plugins.load_all(plugins.TASKS)[1]


def _left_out() -> str:
    broken = _load_plugins()
    return f" (plug-ins that do not import: {', '.join(broken)})" if broken else ""


def _qualified(kind: Any) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
