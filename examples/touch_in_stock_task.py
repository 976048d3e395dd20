"""A sensor on the left finger of the stock Panda, in ManiSkill's own PickCube: `python examples/touch_in_stock_task.py`."""

import gymnasium as gym
import sapien
from mani_skill.envs.tasks import PickCubeEnv
from mani_skill.utils.registration import register_env

from manifeel_ms3.sensors import TactileSensor, sensor_config

ON_FINGER = sapien.Pose([0, 0, 0.0465], [0.5**0.5, 0.5**0.5, 0, 0])  # across it x, to its tip z, towards the other finger -y


@register_env("TouchPickCube-v1", max_episode_steps=50)
class TouchPickCubeEnv(PickCubeEnv):
    def __init__(self, *args, sensor: str = "gelsight_mini", **kwargs):
        self.pad = sensor_config(sensor, "touch", "panda_leftfinger", pad_pose=ON_FINGER)
        super().__init__(*args, **kwargs)

    def _after_reconfigure(self, options):
        super()._after_reconfigure(options)
        self.touch = TactileSensor(self.pad, self.scene, self.agent.robot)

    def _initialize_episode(self, env_idx, options):
        super()._initialize_episode(env_idx, options)
        self.touch.reset(env_idx)

    def _get_obs_extra(self, info):
        self.touch.capture()
        return super()._get_obs_extra(info) | self.touch.get_obs()


if __name__ == "__main__":
    for name in ("gelsight_mini", "digit"):
        env = gym.make("TouchPickCube-v1", obs_mode="state_dict", render_backend="none", sensor=name)
        obs, _ = env.reset(seed=0)
        print(name, obs["extra"]["rgb"].shape, obs["extra"]["force_field"].shape)  # noqa: T201
