"""A robot with nothing but what a test puts in front of its right pad."""

from collections.abc import Callable
from dataclasses import dataclass

import sapien
import torch
from mani_skill.utils.structs import Actor

from manifeel_ms3.tasks import VisuotactileEnv


@dataclass
class NoRandomization:
    pass


class PadBench(VisuotactileEnv):
    """`build(env)` adds actors; `place` puts them in the right pad's frame."""

    Randomization = NoRandomization
    default_control_mode = "pd_ee_delta_pose"

    def __init__(self, build: Callable[["PadBench"], list[Actor]] = lambda env: [], **kwargs):
        self._build = build
        super().__init__(sim_backend="physx_cpu", **kwargs)

    def _load_task(self):
        self.objects = self._build(self)

    def _initialize_task(self, env_idx):
        qpos = torch.tensor(self.agent.keyframes["tool_down"].qpos, dtype=torch.float32)[None]
        self.agent.reset(qpos)

    def place(self, actor: Actor, pose: sapien.Pose) -> None:
        actor.set_pose(self.agent.gels["right"].pose.sp * pose)

    def measure(self):
        return {}

    def goal_reached(self, measures):
        return torch.zeros(self.num_envs, dtype=torch.bool)

    failed = goal_reached

    def _privileged_state(self):
        return {}
