"""Running of one episode in a simulator, and collection of everything that a trajectory file holds of it."""

from collections.abc import Callable, Iterable
from typing import Any, cast

import gymnasium as gym
import numpy as np
from mani_skill.utils import common

from manifeel_ms3.experts import make_expert
from manifeel_ms3.tasks import VisuotactileEnv
from manifeel_ms3.tasks.visuotactile_env import FORCE_DECIMALS

from .formats.maniskill_h5_writing import RecordedEpisode


def demonstrate(env: gym.Env, env_id: str, seed: int) -> RecordedEpisode:
    """Run the scripted demonstrator of a task through one episode."""
    return run_episode(env, seed, lambda: make_expert(env_id, cast(VisuotactileEnv, env.unwrapped), seed).actions())


def run_episode(
    env: gym.Env,
    seed: int,
    actions: Callable[[], Iterable[np.ndarray]],
    on_step: Callable[[dict[str, Any], dict[str, Any]], None] = lambda _obs, _info: None,
) -> RecordedEpisode:
    """Run one episode, and return its observations, states and outcome.

    Args:
        env: Environment with `num_envs=1`.
        seed: Seed of the reset.
        actions: Function that returns the actions (A,); it is called after the reset.
        on_step: Function that is called with every observation and `info`, including those of the reset.
    """
    base: Any = env.unwrapped
    obs, info = env.reset(seed=seed)
    on_step(obs, info)
    observations, states = [common.to_numpy(obs)], [common.to_numpy(base.get_state_dict())]
    steps: dict[str, list] = dict(actions=[], rewards=[], terminated=[], truncated=[], success=[], fail=[], contact_force=[])
    for action in actions():
        action = action.astype(np.float32)
        obs, reward, terminated, truncated, info = env.step(action)
        on_step(obs, info)
        observations.append(common.to_numpy(obs))
        states.append(common.to_numpy(base.get_state_dict()))
        flags = dict(terminated=terminated, truncated=truncated, success=info["success"], fail=info["fail"])
        for name, value in (dict(actions=action) | {k: bool(v) for k, v in flags.items()}).items():
            steps[name].append(value)
        for name, number in dict(rewards=reward, contact_force=info["contact_force"]).items():
            steps[name].append(np.float32(float(number)))
        if terminated or truncated:
            break
    arrays: dict[str, Any] = {name: np.array(values) for name, values in steps.items()}
    if len(observations[0]):  # none with obs_mode "none"; a dict, or the vectors (1, D) of obs_mode "state"
        arrays["obs"] = _stack(observations)
    arrays["env_states"] = _stack(states)
    info = dict(
        reset_kwargs=dict(seed=seed, options={}),
        control_mode=base.control_mode,
        elapsed_steps=len(steps["actions"]),
        success=bool(steps["success"] and steps["success"][-1]),
        fail=bool(steps["fail"] and steps["fail"][-1]),
        peak_contact_force=round(float(max(steps["contact_force"], default=0.0)), FORCE_DECIMALS),
    )
    return RecordedEpisode(seed, arrays, info)


def _stack(trees: list[Any]) -> Any:
    """Turn a list over time of trees with arrays (1, ...), or of such arrays, into one tree or array (T, ...)."""
    first = trees[0]
    if not isinstance(first, dict):
        return np.concatenate(trees)
    return {key: _stack([tree[key] for tree in trees]) for key in first}
