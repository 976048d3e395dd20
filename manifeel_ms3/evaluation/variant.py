"""Variants of a task: its arguments that are not the defaults, such as another fit, light, goal or sensor."""

import inspect
import json
from functools import cache
from typing import Any

from manifeel_ms3.errors import UnknownNameError
from manifeel_ms3.tasks.registry import task_spec

SENSING = ("obs_mode", "cameras", "tactile_sensors")
"""Arguments of the environment that have entries of their own in a checkpoint's configuration; its entry env_kwargs holds the
other arguments, with which the demonstrations were recorded."""
BACKENDS = ("sim_backend", "render_backend")
"""Arguments of an environment that say what computes it; they do not make another variant."""
LENGTHS_OF_RECORDINGS = ("max_episode_steps", "hold_seconds")
"""Arguments that make demonstrations longer; the evaluation of a policy that learnt from them does not take them over."""
OF_A_RECORDER = ("num_envs", "render_mode", "reward_mode", "human_render_camera_configs")
"""Further arguments that tools such as ManiSkill's `replay_trajectory` write into a trajectory file: how it was run."""


def variant_of(env_id: str, env_kwargs: dict[str, Any]) -> str:
    """Arguments of a task that are not its defaults, as json; "" if there are none.

    Args:
        env_id: Id of the task.
        env_kwargs: Arguments of `gym.make`.
    """
    defaults = default_arguments(env_id) | _registered(env_id, env_kwargs)
    other = {
        name: value
        for name, value in env_kwargs.items()
        if name not in (*SENSING, *BACKENDS) and not (name in defaults and defaults[name] == value) and value != {}
    }
    return json.dumps(other, sort_keys=True) if other else ""


def _registered(env_id: str, env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """The time limit and the control mode that a task is registered with; {} for a task that is not registered here."""
    try:
        spec = task_spec(env_id)
    except UnknownNameError:
        return {}
    start = {name: value for name, value in env_kwargs.items() if name == "start"}
    return dict(max_episode_steps=spec.max_episode_steps, control_mode=spec.control_mode(start))


@cache
def default_arguments(env_id: str) -> dict[str, Any]:
    """The defaults of a task's own arguments; {} for a task that is not registered here."""
    try:
        classes = task_spec(env_id).env_class.__mro__
    except UnknownNameError:
        return {}
    parameters = [inspect.signature(one.__init__).parameters for one in reversed(classes) if "__init__" in vars(one)]
    return {
        name: parameter.default
        for of_class in parameters
        for name, parameter in of_class.items()
        if parameter.default is not parameter.empty
    }
