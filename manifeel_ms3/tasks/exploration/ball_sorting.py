"""The tasks ManiFeel-BallSorting-v1 and ManiFeel-BallSortingDim-v1."""

from dataclasses import dataclass

import sapien
import torch
from mani_skill.utils.geometry.rotation_conversions import random_quaternions
from mani_skill.utils.structs import Pose

from manifeel_ms3.arguments import one_of
from manifeel_ms3.geometry.balls import BALL_RADIUS, SEAT_HEIGHT, SEAT_SPACING, ball_stand, golf_ball, tennis_ball
from manifeel_ms3.geometry.containers import BOWL_FLOOR, BOWL_HEIGHT, BOWL_RADIUS, bowl
from manifeel_ms3.rendering.looks import Look
from manifeel_ms3.tasks.placement import OUT_OF_REACH, REACH_XY, WORKSPACE_XY, height_range, start_pose, uniform_in
from manifeel_ms3.tasks.registry import register_task
from manifeel_ms3.tasks.viewpoints import FAR_FRONT_CAMERA_AT, FAR_SIDE_CAMERA_AT
from manifeel_ms3.tasks.visuotactile_env import VisuotactileEnv

STAND_XY = WORKSPACE_XY
"""Nominal position of the stand, in m."""
START_XYZ = (*WORKSPACE_XY, 0.12)
"""Nominal position of the tool at the start, in m (public code of the paper)."""
LIFTED = 0.10
"""Smallest height of the golf ball over its seat, in m, at success (docs/fidelity.md)."""
IN_PLACE = 0.010
"""Distance of a ball from its seat, in m, within which it has stayed in place. Our choice."""
ON_TABLE = 0.005
"""Height of a ball's lowest point over the table, in m, below which it has fallen off the stand. Our choice."""
PAD_END = 0.021
"""Distance from the tool centre point to the fingertips, in m: 18 mm, and some clearance."""
BOWLS = {
    "golf": ((0.40, 0.19), Look((0.85, 0.25, 0.03))),
    "tennis": ((0.40, -0.19), Look((0.03, 0.12, 0.60))),
}
"""Position (x, y) of each ball's bowl, in m, and its look: orange and blue. Chosen by eye."""
GOLF_BUILT_AT, TENNIS_BUILT_AT = (0.45, 0.0, 0.1), (0.55, 0.0, 0.1)
"""Positions at which the balls are built, in m, clear of each other; every reset moves them to their seats."""
GOALS = ("lift", "bowls")
"""Names of the goals: lift the golf ball, or put each ball into its bowl."""
BOWLS_INSTRUCTION = "Find the golf ball by touch, put it into the orange bowl, and put the table-tennis ball into the blue one."


@dataclass(frozen=True)
class BallSortingRandomization:
    """Half ranges of the uniform distributions; the defaults are those of the paper and its public code."""

    stand_xy: float = 0.05
    """Position of the stand on each axis, in m."""
    start_xy: float = 0.0
    """Position of the tool at the start on each horizontal axis, in m."""
    start_z: float = 0.0
    """Height of the tool at the start, in m."""


@dataclass(frozen=True)
class BallSortingRewardConfig:
    """Constants of the task's dense reward, chosen by hand."""

    reach_gain: float = 8.0
    """Gain, in 1/m, on the distance between tool and golf ball: 125 mm away the term is 1 - tanh(1)."""
    bowl_gain: float = 4.0
    """Gain, in 1/m, on the distance between a ball and its bowl: 250 mm away the term is 1 - tanh(1)."""
    bowl_weight: float = 1.5
    """Reward for one ball in its bowl: success adds 1 to that of both balls, which makes 4."""


@register_task(
    "ManiFeel-BallSorting-v1",
    instruction="Find the golf ball by touch, lift it, and leave the table-tennis ball in its place.",
    goal_instructions=dict(bowls=BOWLS_INSTRUCTION),
    max_episode_steps=180,
    category="exploration",
    paper_demos=80,
    paper_tables=("II", "III"),
    demo_megabytes=22.0,
    demo_steps=70,
    revision=4,
    force_limit=12.0,
)
class BallSortingEnv(VisuotactileEnv):
    """Tell a golf ball from a table-tennis ball by touch, and lift it.

    **Task Description:**
    A table-tennis ball and a golf ball of the same size and colour sit on a stand. The gripper lifts the golf ball and leaves
    the other. Only touch can tell which is which: the pads feel the golf ball's 336 dimples, and the cameras do not show them.

    **Randomizations:** (half ranges; the argument `randomization` overrides them)
    - stand: xy +-50 mm around (0.5, 0) m; the balls swap seats with even chances; the golf ball is turned at random
    - gripper start: 120 mm above the table at (0.5, 0) m; open

    **Success Conditions:** held for 0.5 s
    - the golf ball is 100 mm or more above its seat
    - the table-tennis ball is in its own seat (10 mm)

    **Fail Conditions:** a ball lies on the table.

    `goal="bowls"` is the paper's task on the real robot: the golf ball goes into an orange bowl and the other into a blue one.
    It succeeds when each ball has been in its bowl, and out of the hand, for 0.5 s.
    """

    _sample_video_link = "docs/videos/BallSorting.mp4"
    Randomization = BallSortingRandomization
    reward_config = BallSortingRewardConfig()
    policy_cameras = ("front",)
    grips_round_parts = True
    default_control_mode = "pd_ee_delta_pose"
    front_camera_at = FAR_FRONT_CAMERA_AT
    side_camera_at = FAR_SIDE_CAMERA_AT

    def __init__(self, *args, goal: str = "lift", **kwargs):
        self.goal = one_of("goal", goal, GOALS)
        super().__init__(*args, **kwargs)

    def get_language_instruction(self, **_kwargs):
        return [BOWLS_INSTRUCTION] * self.num_envs if self.goal == "bowls" else super().get_language_instruction()

    def _largest_ranges(self):
        lowest = SEAT_HEIGHT + BALL_RADIUS + PAD_END
        return dict(
            stand_xy=(REACH_XY - SEAT_SPACING / 2, OUT_OF_REACH),
            start_xy=(REACH_XY, OUT_OF_REACH),
            start_z=(height_range(START_XYZ[2], lowest), "the fingers would start in the balls, or out of reach"),
        )

    def _load_task(self):
        if self.goal == "bowls":
            for name, ((x, y), look) in BOWLS.items():
                bowl(f"{name}_bowl", look).build(self.scene, "static", sapien.Pose([x, y, 0]))
        self.stand = ball_stand().build(self.scene, "kinematic", sapien.Pose([*STAND_XY, 0]))
        self.golf = golf_ball().build(self.scene, "dynamic", sapien.Pose(GOLF_BUILT_AT))
        self.tennis = tennis_ball().build(self.scene, "dynamic", sapien.Pose(TENNIS_BUILT_AT))
        self.swapped = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)

    def _initialize_task(self, env_idx: torch.Tensor):
        n, ranges = len(env_idx), self.randomization
        stand = torch.tensor([*STAND_XY, 0.0]).repeat(n, 1)
        stand[:, :2] += uniform_in(ranges.stand_xy, n, 2)
        self.stand.set_pose(Pose.create_from_pq(stand))
        swapped = torch.rand(n) < 0.5
        self.swapped[env_idx] = swapped
        side = torch.where(swapped, 1.0, -1.0)[:, None] * torch.tensor([0.0, SEAT_SPACING / 2, 0.0])
        seat = stand + torch.tensor([0.0, 0.0, SEAT_HEIGHT])
        self.golf.set_pose(Pose.create_from_pq(seat + side, random_quaternions(n, device=self.device)))
        self.tennis.set_pose(Pose.create_from_pq(seat - side))
        start = start_pose(n, START_XYZ, (ranges.start_xy, ranges.start_xy, ranges.start_z), 0.0)
        self.agent.reset_tool(start)

    def _state_has_changed(self, changed: torch.Tensor | slice, joint_forces: torch.Tensor | None) -> None:
        """Also let the seats be those of the new state, which may be from an episode with the balls the other way round.

        No state holds the seats: they follow from the balls that lie in them. Where neither ball does, they stay as they are.
        """
        golf_seat, tennis_seat = self._seats()
        places = ((self.golf, tennis_seat), (self.tennis, golf_seat))
        in_others = [torch.linalg.norm(ball.pose.p - seat, dim=1) < IN_PLACE for ball, seat in places]
        self.swapped[changed] ^= (in_others[0] | in_others[1])[changed]
        super()._state_has_changed(changed, joint_forces)

    def _seats(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions (N, 3), in m, that the centres of the golf ball and of the other ball have in their seats."""
        middle = self.stand.pose.p + torch.tensor([0.0, 0.0, SEAT_HEIGHT], device=self.device)
        side = torch.where(self.swapped, 1.0, -1.0)[:, None] * torch.tensor([0.0, SEAT_SPACING / 2, 0.0], device=self.device)
        return middle + side, middle - side

    def measure(self) -> dict[str, torch.Tensor]:
        golf_seat, tennis_seat = self._seats()
        return dict(
            golf_height=self.golf.pose.p[:, 2] - golf_seat[:, 2],  # m, over its seat
            tennis_away=torch.linalg.norm(self.tennis.pose.p - tennis_seat, dim=1),  # m, from its seat
        ) | {f"{name}_to_bowl": self._to_bowl(name) for name in BOWLS if self.goal == "bowls"}

    def _to_bowl(self, ball: str) -> torch.Tensor:
        """Distance (N,), in m, of a ball from its position in the middle of its bowl."""
        middle = torch.tensor([*BOWLS[ball][0], BOWL_FLOOR + BALL_RADIUS], device=self.device)
        return torch.linalg.norm(getattr(self, ball).pose.p - middle, dim=1)

    def _is_in_bowl(self, ball: str) -> torch.Tensor:
        """Whether a ball's centre is within its bowl and below the rim, and the hand has let go of the ball; (N,) bool."""
        body = getattr(self, ball)
        position, middle = body.pose.p, torch.tensor(BOWLS[ball][0], device=self.device)
        within = torch.linalg.norm(position[:, :2] - middle, dim=1) < BOWL_RADIUS
        return within & (position[:, 2] < BOWL_HEIGHT) & ~self.agent.is_grasping(body, max_angle=180.0)

    def goal_reached(self, measures):
        if self.goal == "bowls":
            return self._is_in_bowl("golf") & self._is_in_bowl("tennis")
        return (measures["golf_height"] > LIFTED) & (measures["tennis_away"] < IN_PLACE)

    def paper_goal_reached(self, measures):
        """The golf ball is lifted; the public code does not look at the other one."""
        return measures["golf_height"] > LIFTED if self.goal == "lift" else None

    def failed(self, measures):
        lowest = torch.minimum(self.golf.pose.p[:, 2], self.tennis.pose.p[:, 2])
        return lowest < BALL_RADIUS + ON_TABLE

    def shortcomings(self, measures):
        if self.goal == "bowls":
            return {"a ball beside its bowl": torch.ones_like(self.swapped)}
        wrong, right = measures["tennis_away"] >= IN_PLACE, measures["golf_height"] >= IN_PLACE
        return {"wrong ball taken": wrong, "golf ball taken, not lifted": right, "no ball taken": ~(wrong | right)}

    def _privileged_state(self):
        return dict(golf_pose=self.golf.pose.raw_pose, tennis_pose=self.tennis.pose.raw_pose)

    def compute_dense_reward(self, obs, action, info):
        """Reward in [0, 4]: 1 for reaching the golf ball, 1 for lifting it, 1 for leaving the other, 1 for success.

        With bowls: 1.5 for each ball that comes close to its bowl, 1 for success.
        """
        config = self.reward_config
        if self.goal == "bowls":
            near = [1 - torch.tanh(config.bowl_gain * info[f"{name}_to_bowl"]) for name in BOWLS]
            return config.bowl_weight * (near[0] + near[1]) + info["success"].float()
        reach = 1 - torch.tanh(config.reach_gain * torch.linalg.norm(self.agent.tcp.pose.p - self.golf.pose.p, dim=1))
        lifted = (info["golf_height"] / LIFTED).clamp(0.0, 1.0)
        return reach + lifted + (info["tennis_away"] < IN_PLACE).float() + info["success"].float()


@register_task(
    "ManiFeel-BallSortingDim-v1",
    instruction="Find the golf ball by touch, lift it, and leave the table-tennis ball in its place.",
    goal_instructions=dict(bowls=BOWLS_INSTRUCTION),
    max_episode_steps=180,
    category="exploration",
    paper_demos=80,
    paper_tables=("I", "II", "III"),
    demo_megabytes=16.0,
    demo_steps=70,
    revision=4,
    force_limit=12.0,
)
class BallSortingDimEnv(BallSortingEnv):
    """BallSorting at 5 % of the light."""

    _sample_video_link = "docs/videos/BallSortingDim.mp4"

    def __init__(self, *args, lighting: str = "dim", **kwargs):
        super().__init__(*args, lighting=lighting, **kwargs)
