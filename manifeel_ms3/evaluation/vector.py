"""Vectorized environments for evaluation, made as ManiSkill's baselines make theirs (`make_eval_envs`)."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from mani_skill.utils.gym_utils import find_max_episode_steps_value
from mani_skill.utils.wrappers import CPUGymWrapper, FrameStack, RecordEpisode
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.tasks.registry import make_env, task_spec

Wrapper = Callable[[gym.Env], gym.Env]


def make_eval_envs(
    env_id: str,
    num_envs: int,
    sim_backend: str = "physx_cpu",
    env_kwargs: dict[str, Any] | None = None,
    other_kwargs: dict[str, Any] | None = None,
    video_dir: str | Path | None = None,
    wrappers: Sequence[Wrapper] = (),
) -> VectorEnv | ManiSkillVectorEnv:
    """Environments that run to the time limit, and whose `info["final_info"]["episode"]` holds ManiSkill's metrics.

    The arguments are those of `make_eval_envs` of ManiSkill's baselines.

    Only "physx_cpu" gives the episodes of the evaluation seeds: there, each environment starts from its own seed. With
    "physx_cuda", ManiSkill draws the initial states of all environments together, from the seed of the first one and on the
    GPU. The episodes then repeat with the list of seeds, but are others than those that `manifeel eval` runs, and are no
    part of the protocol.

    Args:
        env_id: Id of the task.
        num_envs: Number of environments. On the CPU each has a process of its own, which is spawned, since a renderer does
            not survive a fork; a script then needs `if __name__ == "__main__":`.
        sim_backend: Backend of the simulation: "physx_cpu", or "physx_cuda" with other initial states, see above.
        env_kwargs: Arguments of `gym.make`.
        other_kwargs: `obs_horizon`, the number of observations that are stacked by ManiSkill's `FrameStack`, which takes flat
            observations only (`obs_mode="state"`, or a wrapper that flattens); they are not stacked if not given.
        video_dir: Folder of videos of the first environment, or with "physx_cuda" of all of them beside each other; they need
            `render_mode="rgb_array"`. No videos if not given.
        wrappers: Wrappers that are applied first; they must be picklable on the CPU.

    Raises:
        InvalidArgumentError: Observations are to be stacked that are not flat.
    """
    env_id, kwargs = task_spec(env_id).env_id, env_kwargs or {}
    horizon = (other_kwargs or {}).get("obs_horizon")
    wrappers = [*wrappers, *([partial(_stacked, num_stack=horizon)] if horizon else [])]
    if sim_backend == "physx_cpu":
        made = [
            partial(_make_on_cpu, env_id, kwargs, wrappers, str(video_dir) if video_dir and index == 0 else None)
            for index in range(num_envs)
        ]
        # an episode that ends is followed by a reset in the same step, as in ManiSkill's vector environments
        if num_envs == 1:
            return SyncVectorEnv(made, autoreset_mode=AutoresetMode.SAME_STEP)
        return AsyncVectorEnv(made, context="spawn", autoreset_mode=AutoresetMode.SAME_STEP)
    env = make_env(env_id, num_envs=num_envs, sim_backend=sim_backend, reconfiguration_freq=1, **kwargs)
    env = _wrapped(env, wrappers, video_dir and str(video_dir))
    return ManiSkillVectorEnv(env, ignore_terminations=True, record_metrics=True)


def _stacked(env: gym.Env, num_stack: int) -> gym.Env:
    space = env.observation_space
    parts = space.spaces if isinstance(space, gym.spaces.Dict) else {}
    if nested := [name for name, part in parts.items() if isinstance(part, gym.spaces.Dict)]:
        raise InvalidArgumentError(
            f"obs_horizon={num_stack}: ManiSkill's FrameStack takes flat observations, and {nested} are nested; give "
            "wrappers=[FlattenVisuotactileObservationWrapper], from manifeel_ms3.wrappers"
        )
    return FrameStack(cast(Any, env), num_stack=num_stack)


def _make_on_cpu(env_id: str, env_kwargs: dict[str, Any], wrappers: Sequence[Wrapper], video_dir: str | None) -> gym.Env:
    env = make_env(env_id, sim_backend="physx_cpu", reconfiguration_freq=1, **env_kwargs)
    return CPUGymWrapper(_wrapped(env, wrappers, video_dir), ignore_terminations=True, record_metrics=True)


def _wrapped(env: gym.Env, wrappers: Sequence[Wrapper], video_dir: str | None) -> gym.Env:
    for wrapper in wrappers:
        env = wrapper(env)
    if video_dir:
        several = cast(Any, env.unwrapped).num_envs > 1
        env = RecordEpisode(
            cast(Any, env),
            output_dir=video_dir,
            save_trajectory=False,
            # of one environment, ManiSkill takes the reward for a number, which numpy 2.4 refuses of an array of one
            info_on_video=several,
            # of several, ManiSkill ends a video after a number of steps, since they may be reset one by one
            max_steps_per_video=find_max_episode_steps_value(env) if several else None,
        )
    return env
