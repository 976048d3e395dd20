"""The task ManiFeel-ObjectSearch-v1."""

from dataclasses import dataclass

import sapien
import torch
from mani_skill.utils.structs import Pose

from manifeel_ms3.geometry.containers import BATTERY_SIZE, CONTAINER_FLOOR, CONTAINER_OUTER, CONTAINER_WALL, battery, container
from manifeel_ms3.tasks.placement import WORKSPACE_XY, height_range, start_pose, uniform_in
from manifeel_ms3.tasks.registry import register_task
from manifeel_ms3.tasks.viewpoints import FAR_FRONT_CAMERA_AT, FAR_SIDE_CAMERA_AT
from manifeel_ms3.tasks.visuotactile_env import VisuotactileEnv

CONTAINER_XY = WORKSPACE_XY
"""Position of the container's middle, in m."""
PLACES_X = (-0.075, 0.075)
"""Places of the battery along x, in m from the container's middle."""
START_XYZ = (*WORKSPACE_XY, 0.07)
"""Position of the tool at the start, in m (public code of the paper): in the container, between the two places."""
HAND = 0.105
"""Half of the hand's width along y, its wider side, in m: 104 mm, and some clearance. At the start, the container's
walls are beside it."""
LOWEST = 0.055
"""Smallest height of the tool over the table at the start, in m: the fingertips are clear of the battery."""
BUILT_HEIGHT = 0.05
"""Height over the table at which the battery is built, in m; every reset moves it to its place."""
LIFTED = 0.10
"""Smallest height of the battery over the container's floor, in m, at success (docs/fidelity.md)."""
OUTSIDE = 0.17
"""Distance of the battery from the container's middle on either axis, in m, beyond which it is outside: the container's half
size, 0.161 m, and a margin."""
PAPER_GOAL = (*WORKSPACE_XY, 0.01)
"""Position from which the public code takes the battery's distance, in m: the container's own."""
PAPER_DISTANCES = (0.12, 0.2)
"""Smallest and largest distance, in m, from `PAPER_GOAL` at which the public code counts a success."""
NOT_LIFTED = 0.02
"""Height of the battery over the container's floor, in m, below which it has not been lifted. Our choice."""


@dataclass(frozen=True)
class ObjectSearchRandomization:
    """Half ranges of the uniform distributions; the tool's are those of the paper's public code."""

    place_xy: float = 0.005
    """Position of the battery on each axis around the place drawn, in m. The paper has exactly two places; without these few
    millimetres, fifty evaluation episodes would be copies of only two."""
    start_xy: float = 0.0
    """Position of the tool at the start on each horizontal axis, in m."""
    start_z: float = 0.0
    """Height of the tool at the start, in m."""


@dataclass(frozen=True)
class ObjectSearchRewardConfig:
    """Constants of the task's dense reward, chosen by hand."""

    reach_gain: float = 8.0
    """Gain, in 1/m, on the distance between tool and battery: 125 mm away the term is 1 - tanh(1)."""


@register_task(
    "ManiFeel-ObjectSearch-v1",
    instruction="Find the battery in the container, and lift it.",
    max_episode_steps=160,
    category="exploration",
    paper_demos=50,
    paper_tables=("I", "II", "III"),
    demo_megabytes=10.0,
    demo_steps=71,
    revision=4,
    force_limit=8.0,
)
class ObjectSearchEnv(VisuotactileEnv):
    """Find a battery in a container that the camera cannot see into, and lift it.

    **Task Description:**
    A battery block, a cube of 25 mm, lies in one of two places on the floor of an opaque container, 322 x 281 x 161 mm, that
    the policy's camera, in front of it, cannot look into. The gripper finds it by touch and lifts it.

    **Randomizations:** (the argument `randomization` overrides the half ranges)
    - battery: one of two places, 150 mm apart along x, with even chances; +-5 mm
    - gripper start: 70 mm above the table, in the container between the two places; open

    **Success Conditions:** held for 0.5 s
    - the battery is 100 mm or more above the container's floor

    **Fail Conditions:** the battery is outside the container and not lifted.

    `occlusion=False` leaves the container's front undrawn.
    """

    _sample_video_link = "docs/videos/ObjectSearch.mp4"
    Randomization = ObjectSearchRandomization
    reward_config = ObjectSearchRewardConfig()
    policy_cameras = ("front",)
    default_control_mode = "pd_ee_delta_pose_fixed_rotation"
    has_occluder = True
    max_reward = 3.0
    front_camera_at = FAR_FRONT_CAMERA_AT
    side_camera_at = FAR_SIDE_CAMERA_AT

    def _largest_ranges(self):
        to_wall = CONTAINER_OUTER[0] / 2 - CONTAINER_WALL - PLACES_X[1] - BATTERY_SIZE / 2
        to_hand = CONTAINER_OUTER[1] / 2 - CONTAINER_WALL - HAND  # along y, where the room is less than along x
        return dict(
            place_xy=(to_wall, "the battery would start in the container's wall"),
            start_xy=(to_hand, "the hand would start in the container's wall"),
            start_z=(height_range(START_XYZ[2], LOWEST), "the fingers would start in the battery, or out of reach"),
        )

    def _load_task(self):
        self.container = container(self.occlusion).build(self.scene, "static", sapien.Pose([*CONTAINER_XY, 0]))
        self.battery = battery().build(self.scene, "dynamic", sapien.Pose([*CONTAINER_XY, BUILT_HEIGHT]))
        self.place = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)

    def _initialize_task(self, env_idx: torch.Tensor):
        n, ranges = len(env_idx), self.randomization
        self.place[env_idx] = torch.randint(2, (n,))
        position = torch.zeros(n, 3)
        position[:, 0] = CONTAINER_XY[0] + torch.tensor(PLACES_X)[self.place[env_idx]]
        position[:, :2] += uniform_in(ranges.place_xy, n, 2)
        position[:, 2] = CONTAINER_FLOOR + BATTERY_SIZE / 2
        self.battery.set_pose(Pose.create_from_pq(position))
        start = start_pose(n, START_XYZ, (ranges.start_xy, ranges.start_xy, ranges.start_z), 0.0)
        self.agent.reset_tool(start)

    def measure(self) -> dict[str, torch.Tensor]:
        position = self.battery.pose.p
        return dict(
            height=position[:, 2] - CONTAINER_FLOOR - BATTERY_SIZE / 2,  # m, over where it lay
            distance=torch.linalg.norm(position - torch.tensor(PAPER_GOAL, device=self.device), dim=1),  # m
            away=(position[:, :2] - torch.tensor(CONTAINER_XY, device=self.device)).abs().amax(1),  # m, from the middle
        )

    def goal_reached(self, measures):
        return measures["height"] > LIFTED

    def paper_goal_reached(self, measures):
        return (measures["distance"] > PAPER_DISTANCES[0]) & (measures["distance"] < PAPER_DISTANCES[1])

    def failed(self, measures):
        return (measures["away"] > OUTSIDE) & (measures["height"] < NOT_LIFTED)

    def shortcomings(self, measures):
        lying = measures["height"] < NOT_LIFTED
        return {"battery not gripped": lying, "battery gripped, not lifted": ~lying}

    def _privileged_state(self):
        return dict(battery_pose=self.battery.pose.raw_pose)

    def compute_dense_reward(self, obs, action, info):
        """Reward in [0, 3]: 1 for reaching the battery, 1 for lifting it, 1 for success."""
        distance = torch.linalg.norm(self.agent.tcp.pose.p - self.battery.pose.p, dim=1)
        reach = 1 - torch.tanh(self.reward_config.reach_gain * distance)
        return reach + (info["height"] / LIFTED).clamp(0.0, 1.0) + info["success"].float()
