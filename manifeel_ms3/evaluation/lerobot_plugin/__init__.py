"""What LeRobot's command line needs to know of the tasks: the type of environment "manifeel".

LeRobot imports this package where it is told to, with `--env.discover_packages_path=manifeel_ms3.evaluation.lerobot_plugin`.
"""

# pyright: reportMissingImports=false
# (LeRobot needs another torch than the rest of the tests, and is not installed beside it)
import json
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from manifeel_ms3.command_line import missing_extras_named
from manifeel_ms3.evaluation.lerobot_env import GYM_ID, LeRobotEnv
from manifeel_ms3.tasks.visuotactile_env import CONTROL_FREQ

with missing_extras_named():
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.envs.configs import EnvConfig
    from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE


@EnvConfig.register_subclass("manifeel")
@dataclass
class ManiFeelEnvConfig(EnvConfig):
    """A task of manifeel_ms3."""

    task: str | None = "ManiFeel-PegInsertion-v1"
    """Id of the task."""
    fps: int = CONTROL_FREQ
    """Control steps per second."""
    obs_mode: str = "rgb+tacrgb"
    """Observation mode, such as "rgb", "rgb+tacrgb"."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Further arguments of the task; json on the command line."""
    features: dict[str, Any] = field(default_factory=dict)
    """Features that a policy takes; those of the task are added."""
    features_map: dict[str, str] = field(default_factory=dict)
    """LeRobot's names of the features."""

    def __post_init__(self):
        observations, actions = _spaces(str(self.task), self.obs_mode, json.dumps(self.env_kwargs))
        self.features[ACTION] = PolicyFeature(type=FeatureType.ACTION, shape=actions.shape)
        self.features["agent_pos"] = PolicyFeature(type=FeatureType.STATE, shape=observations["agent_pos"].shape)
        self.features_map |= {ACTION: ACTION, "agent_pos": OBS_STATE}
        for name, image in observations.spaces.get("pixels", {}).items():
            self.features[f"pixels/{name}"] = PolicyFeature(type=FeatureType.VISUAL, shape=image.shape)
            self.features_map[f"pixels/{name}"] = f"{OBS_IMAGES}.{name}"

    @property
    def gym_id(self) -> str:
        """Id for `gym.make`."""
        return GYM_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments for `gym.make`."""
        return dict(env_id=self.task, obs_mode=self.obs_mode, env_kwargs=self.env_kwargs)


@cache
def _spaces(env_id: str, obs_mode: str, env_kwargs: str) -> tuple[Any, Any]:
    """The spaces of observations and actions."""
    env = LeRobotEnv(env_id, obs_mode, json.loads(env_kwargs))
    env.close()
    return env.observation_space, env.action_space
