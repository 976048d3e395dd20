"""The task ManiFeel-GearAssembly-v1."""

from dataclasses import dataclass

import sapien
import torch
from mani_skill.utils.geometry.rotation_conversions import quaternion_apply
from mani_skill.utils.structs import Pose

from manifeel_ms3.geometry import gear_fit
from manifeel_ms3.geometry.gears import BASE_SIZE, SHAFT_X, neighbour_gear
from manifeel_ms3.tasks.placement import turned_about, uniform_in
from manifeel_ms3.tasks.registry import register_task
from manifeel_ms3.tasks.visuotactile_env import CONTACTS

from .base import SOCKET_XY, InsertionEnv, InsertionRandomization

NEIGHBOURS = ("small", "large")
"""Names of the gears that turn freely beside the held one."""
ON_SHAFT = 1.0e-3
"""Largest displacement of a neighbouring gear from its place, in m, at success. Our choice."""


@dataclass(frozen=True)
class GearRandomization(InsertionRandomization):
    """Half ranges of the uniform distributions; the defaults are those of the paper and its public code."""

    base_yaw: float = 0.0
    """Rotation of the base about the vertical, in rad."""


@register_task(
    "ManiFeel-GearAssembly-v1",
    instruction="Put the gear onto its shaft between the two other gears.",
    max_episode_steps=590,
    category="insertion",
    paper_demos=100,
    paper_tables=("I", "II", "III"),
    demo_megabytes=22.0,
    demo_steps=131,
    revision=4,
    force_limit=27.0,
)
class GearAssemblyEnv(InsertionEnv):
    """Put a gear onto its shaft between two others, with which its teeth mesh.

    **Task Description:**
    The gripper holds the medium one of three gears (19 teeth, 42 mm across) by a handle and puts it on the middle shaft of a
    base, between a small (9) and a large one (29) that turn freely, so that its teeth mesh with both. With `fit="paper"` its
    bore has 0.5 mm of play on each side and the shaft a chamfered tip, as in the paper's public code; with `fit="tight"` the
    play is 0.15 mm, and the tip blunt.

    **Randomizations:** (half ranges; the argument `randomization` overrides them)
    - base: xy +-50 mm around (0.5, 0) m; the neighbours are turned at random; `base_yaw`, 0 by default, turns the base in its
      plane, as the paper does on the real robot
    - gripper start: 200 mm above the table, xy +-100 mm, z +-50 mm, +-0.1 rad about each axis
    - gear in hand: pitch about the closing axis +-10 degrees

    **Success Conditions:** held for 0.5 s
    - the gear is on its shaft, within 1 mm of the base, tilted by less than 3 degrees
    - both neighbouring gears are on their shafts, so that the teeth mesh

    **Fail Conditions:** the gear has left the grip (30 mm).
    """

    _sample_video_link = "docs/videos/GearAssembly.mp4"
    Randomization = GearRandomization
    contacts = CONTACTS | dict(enable_pcm=False)  # with persistent manifolds, teeth that only touch count as millimetres deep
    make_fit = staticmethod(gear_fit)
    paper_threshold = 0.008
    lift = 0.05

    def _load_task(self):
        super()._load_task()
        self.neighbours = {
            name: neighbour_gear(name, self.fit_name).build(
                self.scene, "dynamic", sapien.Pose([SOCKET_XY[0] + SHAFT_X[name], SOCKET_XY[1], BASE_SIZE[2]])
            )
            for name in NEIGHBOURS
        }

    def _largest_ranges(self):
        return super()._largest_ranges() | dict(base_yaw=(torch.pi, "that is a full turn"))

    def _initialize_task(self, env_idx: torch.Tensor):
        super()._initialize_task(env_idx)
        n = len(env_idx)
        if self.randomization.base_yaw > 0:
            turned = turned_about(2, uniform_in(self.randomization.base_yaw, n))
            self.socket.set_pose(Pose.create_from_pq(self.socket.pose.p[env_idx], turned))
        for name, actor in self.neighbours.items():
            actor.set_pose(Pose.create_from_pq(self._place_of(name)[env_idx], turned_about(2, uniform_in(torch.pi, n))))

    def _place_of(self, neighbour: str) -> torch.Tensor:
        """Position (N, 3), in m, where a neighbouring gear belongs."""
        place = torch.tensor([SHAFT_X[neighbour], 0.0, BASE_SIZE[2]], device=self.device).expand(self.num_envs, 3)
        return self.socket.pose.p + quaternion_apply(self.socket.pose.q, place)

    def measure(self) -> dict[str, torch.Tensor]:
        off = [torch.linalg.norm(actor.pose.p - self._place_of(name), dim=1) for name, actor in self.neighbours.items()]
        return super().measure() | dict(neighbours_off=torch.stack(off).amax(0))  # m, the larger of the two

    def goal_reached(self, measures):
        return super().goal_reached(measures) & (measures["neighbours_off"] < ON_SHAFT)

    def shortcomings(self, measures):
        return {"a neighbouring gear pushed off its shaft": measures["neighbours_off"] >= ON_SHAFT} | super().shortcomings(
            measures
        )

    def _privileged_state(self):
        return super()._privileged_state() | {f"{name}_gear_pose": a.pose.raw_pose for name, a in self.neighbours.items()}
