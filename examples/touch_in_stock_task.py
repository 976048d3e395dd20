"""A sensor on the left finger of the stock Panda, in ManiSkill's own PickCube: `python examples/touch_in_stock_task.py`."""

import gymnasium as gym
from mani_skill.envs.tasks import PickCubeEnv
from mani_skill.utils.registration import register_env

from manifeel_ms3.sensors import TactileSensor, pad_pose, sensor_config

LINK = "panda_leftfinger"
POSE = pad_pose(facing=(0, -1, 0), tip=(0, 0, 1), at=(0, 0, 0.0465))  # on the right finger: facing=(0, 1, 0)


@register_env("TouchPickCube-v1", max_episode_steps=50)
class TouchPickCubeEnv(PickCubeEnv):
    def __init__(self, *args, sensor: str = "gelsight_mini", **kwargs):
        self.pad = sensor_config(sensor, "touch", LINK, pad_pose=POSE)
        super().__init__(*args, **kwargs)

    def _after_reconfigure(self, options):
        super()._after_reconfigure(options)
        self.touch = TactileSensor(self.pad, self.scene, self.agent.robot)

    def _initialize_episode(self, env_idx, options):
        super()._initialize_episode(env_idx, options)
        self.touch.reset(env_idx, self._episode_seed[env_idx.cpu().numpy()])

    def _get_obs_extra(self, info):
        self.touch.capture()  # of all environments: docs/sensor.md says what is needed where some of several are reset
        touch = self.touch.get_obs()
        if self.obs_mode == "state":  # this mode needs vectors
            touch = dict(force_field=touch["force_field"].flatten(1))
        return super()._get_obs_extra(info) | touch


if __name__ == "__main__":
    for name in ("gelsight_mini", "digit"):
        env = gym.make("TouchPickCube-v1", obs_mode="state_dict", render_backend="none", sensor=name)
        obs, _ = env.reset(seed=0)
        print(name, obs["extra"]["rgb"].shape, obs["extra"]["force_field"].shape)  # noqa: T201
