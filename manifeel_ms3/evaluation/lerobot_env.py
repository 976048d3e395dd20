r"""The tasks as environments of LeRobot, and `make_env`, the function that LeRobot's EnvHub looks for.

A repository of the EnvHub needs a file env.py with `make_env` in it: `examples/lerobot_envhub` is such a repository. With the
command line of LeRobot, and without the Hub, the plug-in beside this module names the same environments:

    lerobot-eval --env.discover_packages_path=manifeel_ms3.evaluation.lerobot_plugin --env.type=manifeel \
        --env.task=ManiFeel-PegInsertion-v1 --env.obs_mode=rgb+tacrgb --policy.path=outputs/act \
        --seed=100000 --eval.n_episodes=50

Observations have the keys that LeRobot's `preprocess_observation` knows, and become the features of datasets that
`manifeel export --to lerobot` writes. Nothing here imports LeRobot.
"""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from mani_skill.utils.gym_utils import find_max_episode_steps_value
from mani_skill.utils.wrappers import CPUGymWrapper

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.tasks import registry
from manifeel_ms3.tasks.obs_modes import PAD, STATE_TOKENS

GYM_ID = "manifeel_ms3/LeRobot-v0"
"""Id under which gymnasium makes a `LeRobotEnv`."""


class LeRobotEnv(gym.Env):
    """One task with the observations, the `info` and the attributes that LeRobot's evaluation asks for.

    An observation holds `pixels`, a dict with the image of each camera and of each pad (`tactile_right`); `agent_pos`, the pose
    of the tool in the base frame (7,), m and wxyz; and `tactile.<side>.force_field`, N (LeRobot before version 0.5 drops
    keys that it does not know). An episode ends at success, at failure or at the time limit.

    Args:
        env_id: Id of the task.
        obs_mode: Observation mode, such as "rgb+tacrgb"; it must not hold the simulation's state.
        env_kwargs: Further arguments of the task.
    """

    render_mode: str | None = "rgb_array"

    def __init__(self, env_id: str, obs_mode: str = "rgb", env_kwargs: dict[str, Any] | None = None):
        given = env_kwargs or {}
        if not {"none", *STATE_TOKENS}.isdisjoint(obs_mode.split("+")):
            raise InvalidArgumentError(
                f"obs_mode={obs_mode!r} holds the simulation's state, or nothing; give modalities such as rgb+tacrgb"
            )
        if given.get("render_backend") == "none":  # nothing can be shown
            self.render_mode = None
        kwargs = dict(obs_mode=obs_mode, sim_backend="physx_cpu", render_mode=self.render_mode) | given
        self._env: Any = CPUGymWrapper(registry.make_env(env_id, **kwargs))
        self.metadata = dict(render_modes=["rgb_array"], render_fps=self._env.unwrapped.control_freq)
        spec = registry.task_spec(env_id)
        self.task = spec.name
        (self.task_description,) = self._env.unwrapped.get_language_instruction()
        self._max_episode_steps = find_max_episode_steps_value(self._env)  # that of the task, or the one given
        self.action_space = self._env.action_space
        first, _ = self._env.reset()
        self.observation_space = _space_of(_as_lerobot(first))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode. The options are for LeRobot's own wrappers, and are not used here."""
        super().reset(seed=seed)
        obs, info = self._env.reset(seed=seed)
        return _as_lerobot(obs), _info_of(info)

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self._env.step(action)
        return _as_lerobot(obs), float(reward), bool(terminated), bool(truncated), _info_of(info)

    def render(self) -> np.ndarray:
        return np.asarray(self._env.render())

    def close(self) -> None:
        self._env.close()


def _as_lerobot(obs: dict[str, Any]) -> dict[str, Any]:
    """The observation with LeRobot's keys."""
    pixels, fields = {}, {}
    for name, sensor in obs.get("sensor_data", {}).items():
        if "rgb" in sensor:
            pixels[name] = sensor["rgb"]
        if "force_field" in sensor:
            fields[f"tactile.{name.removeprefix(PAD)}.force_field"] = sensor["force_field"]
    images = dict(pixels=pixels) if pixels else {}
    return images | dict(agent_pos=np.asarray(obs["extra"]["tcp_pose"], np.float32)) | fields


def _space_of(value: Any) -> gym.Space:
    if isinstance(value, dict):
        return gym.spaces.Dict({name: _space_of(part) for name, part in value.items()})
    if value.dtype == np.uint8:
        return gym.spaces.Box(0, 255, value.shape, np.uint8)
    return gym.spaces.Box(-np.inf, np.inf, value.shape, np.float32)


def _info_of(info: dict[str, Any]) -> dict[str, Any]:
    return dict(is_success=bool(info["success"]), fail=bool(info["fail"]), contact_force=float(info["contact_force"]))


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None) -> dict[str, dict[int, VectorEnv]]:
    """Vectorized environments by the category of their task and by a number, as LeRobot's EnvHub asks for them.

    Args:
        n_envs: Number of environments of each task.
        use_async_envs: Whether each environment has a process of its own. A script then needs `if __name__ == "__main__":`,
            because processes are spawned: a renderer does not survive a fork.
        cfg: Configuration of LeRobot, if there is one. These of its attributes count: `task`, the id of a task, or several
            joined by commas ("ManiFeel-PegInsertion-v1" without it); `obs_mode` ("rgb+tacrgb" without it); and `env_kwargs`.

    Raises:
        UnknownNameError: A task is not registered.
        InvalidArgumentError: There is no environment to make.
    """
    if n_envs < 1:
        raise InvalidArgumentError(f"n_envs={n_envs} must be at least 1")
    tasks = getattr(cfg, "task", None) or "ManiFeel-PegInsertion-v1"
    obs_mode, kwargs = getattr(cfg, "obs_mode", "rgb+tacrgb"), getattr(cfg, "env_kwargs", None)
    suites: dict[str, dict[int, VectorEnv]] = {}
    for env_id in tasks.split(","):
        spec = registry.task_spec(env_id.strip())
        suite = suites.setdefault(spec.category, {})
        made = [partial(LeRobotEnv, spec.env_id, obs_mode, kwargs) for _ in range(n_envs)]
        if use_async_envs and n_envs > 1:
            suite[len(suite)] = AsyncVectorEnv(made, context="spawn", autoreset_mode=AutoresetMode.SAME_STEP)
        else:
            suite[len(suite)] = SyncVectorEnv(made, autoreset_mode=AutoresetMode.SAME_STEP)
    return suites


if GYM_ID not in gym.registry:
    # without gymnasium's wrappers, which hide the attributes that LeRobot reads
    gym.register(GYM_ID, entry_point=f"{__name__}:LeRobotEnv", order_enforce=False, disable_env_checker=True)
