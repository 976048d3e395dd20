"""Checks of the arguments that a task's environment is made and reset with."""

import inspect
import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from decimal import ROUND_DOWN, Context
from typing import Any

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.system.backend import render_backend_name_mapping, sim_backend_name_mapping
from mani_skill.render import PREBUILT_SHADER_CONFIGS
from mani_skill.sensors.camera import CameraConfig

from manifeel_ms3.arguments import by_name, is_number, one_of
from manifeel_ms3.errors import InvalidArgumentError, MachineError
from manifeel_ms3.rendering.backend import FORKED, NO_RENDERER, OTHER_DEVICE, is_gpu, renderer_lost

from .obs_modes import has_images

log = logging.getLogger(__name__)
Limits = Mapping[str, tuple[float, str]]
"""By the name of a field of a randomization: its largest playable half range, in m or rad, and what happens beyond it."""


def checked_randomization(
    env_name: str, kind: Any, overrides: Any, limits: Limits, argument: str = "randomization", example: str = "socket_xy"
) -> Any:
    """Make a task's randomization from the fields that a caller overrides.

    Args:
        env_name: Name of the task's class, for messages.
        kind: Dataclass of the randomization.
        overrides: Half ranges by field name.
        limits: Largest half ranges by field name, and what happens beyond them.
        argument: Name of the argument that holds the fields, for messages.
        example: Name of a field, for messages.

    Raises:
        InvalidArgumentError: A field is unknown, or its value is not a number, negative or too large.
    """
    known = kind.__dataclass_fields__
    for name, value in by_name(argument, overrides, f"dict({example}=0.01)").items():
        if name not in known:
            raise InvalidArgumentError(f"{argument}[{name!r}] is unknown for {env_name}; known: {list(known)}")
        if not (is_number(value) and value >= 0):
            raise InvalidArgumentError(f"{argument}[{name!r}]={value!r} must be a finite number >= 0")
        if known[name].type in (int, "int") and value != int(value):
            raise InvalidArgumentError(f"{argument}[{name!r}]={value!r} must be a whole number")
        limit, reason = limits.get(name, (np.inf, ""))
        if value > limit:
            raise InvalidArgumentError(f"{argument}[{name!r}]={value!r} is too large, at most {_rounded_down(limit)}: {reason}")
    return kind(**overrides)


def _rounded_down(limit: float) -> str:
    """A limit with three digits, for a message that says what is allowed; rounded up, it would be refused itself."""
    return str(Context(prec=3, rounding=ROUND_DOWN).create_decimal(str(limit)))


def check_argument_names(task: type, given: Collection[str]) -> None:
    """Check the names of the arguments with which a task's environment is made.

    Args:
        task: Class of the task.
        given: Names that no constructor of the task has taken before ManiSkill's.

    Raises:
        InvalidArgumentError: No constructor has an argument of this name; the message lists those that they have.
    """
    constructors = [vars(base)["__init__"] for base in task.__mro__[:-1] if "__init__" in vars(base)]
    parameters = [p for constructor in constructors for p in inspect.signature(constructor).parameters.values()]
    known = {p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)} - {"self"}
    if unknown := sorted(set(given) - known):
        raise InvalidArgumentError(f"{task.__name__} has no arguments {unknown}; choose from {sorted(known)}")


def check_obs_mode(flag: str, given: Mapping[str, Any], obs_mode: str) -> None:
    """Check that the arguments of a flag do not make the task with other observations than those of the policy.

    Args:
        flag: Flag with the arguments, for the message.
        given: Arguments of the task by name.
        obs_mode: Observation mode of the policy, which the result names.

    Raises:
        InvalidArgumentError: They have another observation mode.
    """
    if (other := given.get("obs_mode", obs_mode)) != obs_mode:
        raise InvalidArgumentError(
            f"{flag} have obs_mode {other!r}, but the policy observes {obs_mode!r}; leave it out there, and choose the "
            "observations of a --policy or a training by --obs-mode"
        )


def check_base_arguments(task: type[BaseEnv], render_backend: Any, given: Mapping[str, Any]) -> None:
    """Check arguments of ManiSkill's `BaseEnv`, which fails on their values by other errors, late, or not at all.

    Args:
        task: Class of the task.
        render_backend: Its argument `render_backend`.
        given: The other arguments of `BaseEnv` that are given.

    Raises:
        InvalidArgumentError: A value is not allowed; the message lists those that are.
        MachineError: A simulation on a GPU is asked for, and this machine has no CUDA GPU.
    """
    _check_num_envs(given.get("num_envs", 1))
    one_of("reward_mode", given.get("reward_mode"), (None, *task.SUPPORTED_REWARD_MODES))
    one_of("render_mode", given.get("render_mode"), (None, *task.metadata["render_modes"]))
    _check_backend("render_backend", render_backend, ("auto", "none", *render_backend_name_mapping), ("pci",))
    sim_backend = given.get("sim_backend", "auto")
    _check_backend("sim_backend", sim_backend, ("auto", *sim_backend_name_mapping))
    if simulates_on_gpu(given) and not torch.cuda.is_available():
        raise MachineError(f"sim_backend={sim_backend!r} needs a CUDA GPU, and torch finds none; leave it out to use the CPU")
    if simulates_on_gpu(given) and not getattr(task, "contacts", {}).get("enable_pcm", True):
        log.warning("%s may not be playable on a GPU, where SAPIEN has other contacts than it needs", task.__name__)


def simulates_on_gpu(given: Mapping[str, Any]) -> bool:
    """Whether arguments of ManiSkill's `BaseEnv` ask for a simulation on a GPU."""
    name = str(given.get("sim_backend", "auto")).partition(":")[0]
    return given.get("num_envs", 1) != 1 if name == "auto" else sim_backend_name_mapping.get(name) == "physx_cuda"


def check_renderer(backend: str, asked: str, own_mode: str, given: Mapping[str, Any]) -> None:
    """Check that the images that are asked for can be drawn.

    Args:
        backend: Where this process renders; "none" if it does not.
        asked: Argument `render_backend` of the environment.
        own_mode: The part of the observation mode that ManiSkill knows.
        given: The other arguments of `BaseEnv` that are given.

    Raises:
        InvalidArgumentError: Images are asked for, and no renderer.
        MachineError: There is no renderer, or it is on another device than a simulation on a GPU, which it could not read.
    """
    if has_images(own_mode):
        wanted = f"obs_mode={own_mode!r}"
    elif render_mode := given.get("render_mode"):
        wanted = f"render_mode={render_mode!r}"
    else:
        return
    if asked == "none":
        raise InvalidArgumentError(
            f"render_backend='none' draws nothing, and {wanted} needs images; leave it out, or ask for no images"
        )
    if backend == "none":
        raise MachineError((FORKED if renderer_lost() else NO_RENDERER).format(wanted=wanted))
    if simulates_on_gpu(given) and not is_gpu(backend):
        raise MachineError(OTHER_DEVICE.format(wanted=wanted))


def _check_backend(argument: str, given: Any, allowed: Sequence[str], with_device: Sequence[str] = ()) -> None:
    """Check the name of a backend, which a device may follow, as in "cuda:1"; those in `with_device` must have one."""
    name, *device = str(given).split(":")
    if name not in (*allowed, *(with_device if device else ())):
        raise InvalidArgumentError(f"{argument}={given!r} is unknown; choose from {list(allowed)}")


def _check_num_envs(num_envs: Any) -> None:
    """Check the number of environments that are simulated at once."""
    if type(num_envs) is not int or num_envs < 1:
        raise InvalidArgumentError(f"num_envs={num_envs!r} must be a whole number of at least 1")
    if num_envs > 1 and not torch.cuda.is_available():
        raise MachineError(
            f"num_envs={num_envs}: many environments in one process need a CUDA GPU, and torch finds none; use several "
            "processes (gymnasium's AsyncVectorEnv, --num-procs and --num-eval-envs of the commands)"
        )


def check_seed(seed: Any) -> None:
    """Check a seed, or one seed for each environment.

    Raises:
        InvalidArgumentError: A seed is not a whole number from 0 to 2**32 - 1.
    """
    seeds = seed if isinstance(seed, list | tuple) else np.atleast_1d(seed) if isinstance(seed, np.ndarray) else [seed]
    are_sound = len(seeds) > 0 and all(isinstance(one, int | np.integer) and 0 <= one < 2**32 for one in seeds)
    if seed is not None and not are_sound:
        raise InvalidArgumentError(
            f"seed={seed!r} must be a whole number from 0 to 2**32 - 1, or one such number for each environment"
        )


def checked_reset(seed: Any, env_idx: Any, num_envs: int, device: torch.device) -> tuple[Any, torch.Tensor]:
    """Check the arguments of a reset; return the seeds as ManiSkill takes them, and the indices (n,) of what is reset.

    Args:
        seed: Seed, or one seed for each environment.
        env_idx: Indices as a tensor, an array or a list; all environments if None.
        num_envs: Number of environments.
        device: Device of the result.

    Raises:
        InvalidArgumentError: A seed is not allowed, several environments have another number of seeds, or the indices are
            none, or not those of environments, each at most once.
    """
    check_seed(seed)
    if num_envs > 1 and isinstance(seed, list | tuple | np.ndarray) and len(seed) not in (1, num_envs):
        raise InvalidArgumentError(
            f"seed={seed!r} has {len(seed)} numbers; give one number, or one for each environment: {num_envs} in all"
        )
    if isinstance(seed, tuple | np.ndarray):
        seed = np.atleast_1d(seed).tolist()
    every = torch.arange(num_envs, device=device)
    if env_idx is None:
        return seed, every
    try:
        chosen = torch.as_tensor(env_idx, device=device)
    except (TypeError, ValueError, RuntimeError):
        chosen = every[:0]
    is_list = chosen.ndim == 1 and len(chosen) > 0 and chosen.dtype in (torch.int32, torch.int64)
    if not is_list or not torch.isin(chosen, every).all() or len(chosen.unique()) < len(chosen):
        raise InvalidArgumentError(
            f"the option env_idx={env_idx!r} must list environments to reset by their indices, from 0 to {num_envs - 1}, each "
            "at most once; of a mask, give mask.nonzero()[:, 0]"
        )
    return seed, chosen


def split_sensor_configs(given: Any, cameras: Collection[str], pads: Collection[str]) -> tuple[dict, dict]:
    """Split ManiSkill's `sensor_configs` into those of the cameras and those of the tactile pads.

    Args:
        given: Fields to change of one sensor, as a dict by its name, and fields to change of every camera. Fields of a pad are
            nested dicts or have dotted names; `width` and `height` together are its `image_shape`.
        cameras: Names of the cameras.
        pads: Names of the pads.

    Returns:
        The part of the cameras, and the fields of each pad by dotted name.

    Raises:
        InvalidArgumentError: A name is neither that of a sensor nor of a camera's field.
    """
    example = 'dict(wrist=dict(width=128), tactile_right={"optics.noise": 2.0})'
    fields = [*CameraConfig.__dataclass_fields__, "use_stereo_depth"]
    of_cameras, of_pads = {}, {}
    for name, value in by_name("sensor_configs", given, example).items():
        if name in pads:
            of_pads[name] = _pad_fields(by_name(f"sensor_configs[{name!r}]", value, example))
        elif name in cameras:
            of_cameras[name] = dict(by_name(f"sensor_configs[{name!r}]", value, example))  # a copy, which ManiSkill changes
            if unknown := [key for key in value if key not in fields]:
                raise InvalidArgumentError(
                    f"sensor_configs[{name!r}]: {unknown} are not fields of a camera; choose from {fields}"
                )
            _check_shader_pack(f"sensor_configs[{name!r}]", value)
        elif name in fields:
            of_cameras[name] = value
        else:
            raise InvalidArgumentError(
                f"sensor_configs[{name!r}] is neither a sensor of this environment {[*cameras, *pads]} nor a field of every "
                f"camera {fields}"
            )
    _check_shader_pack("sensor_configs", of_cameras)
    return of_cameras, of_pads


def _pad_fields(given: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a pad by dotted name, with the size of its image in the pad's own words instead of ManiSkill's."""
    fields = dict(_dotted(given))
    if {"width", "height"} <= fields.keys():
        fields["image_shape"] = (fields.pop("height"), fields.pop("width"))
    return fields


def _check_shader_pack(argument: str, fields: Mapping[str, Any]) -> None:
    if "shader_pack" in fields:
        one_of(f"{argument}['shader_pack']", fields["shader_pack"], PREBUILT_SHADER_CONFIGS)


def _dotted(options: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Leaves of nested options by dotted names: ("optics.noise", 2.0) of {"optics": {"noise": 2.0}}."""
    for name, value in options.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
