"""The base class of the screwing tasks: a held part with a thread, and the fixed part that it is screwed onto or into."""

from dataclasses import dataclass

import numpy as np
import sapien
import torch
from mani_skill.utils.geometry.rotation_conversions import axis_angle_to_quaternion, quaternion_apply, quaternion_multiply
from mani_skill.utils.structs import Pose

from manifeel_ms3.geometry import Screw
from manifeel_ms3.tasks.placement import BUILT_AT, POINTING_DOWN, WORKSPACE_XY, height_range, start_pose, uniform_in
from manifeel_ms3.tasks.visuotactile_env import CONTACTS, VisuotactileEnv

FIXED_XY = WORKSPACE_XY
"""Nominal position of the fixed part, in m."""
START_Z = 0.12
"""Nominal height of the tool at the start, in m (public code of the paper)."""
WOUND_UP = np.deg2rad(200)
"""Rotation of the hand about the vertical at the start, in rad: near the limit of its last joint, so that the first turn is
long. The public code starts at 0."""
MAX_XY = 0.07
"""Largest half range of horizontal positions, in m, within which the wrist can be turned all the way."""
CLEAR = 0.02
"""Smallest height at the start over the first contact of the threads, in m. Set once; not tuned."""
WRIST_END = "further out the wrist reaches its limit"
"""What happens beyond `MAX_XY`, for messages."""
LOST = 0.05
"""Distance of the held part from the tool, in m, beyond which it is out of the hand. Our choice."""
OFF_AXIS = 0.004
"""Distance of the held part from the fixed part's axis, in m, beyond which it is off the axis. Our choice."""


@dataclass(frozen=True)
class ScrewingRandomization:
    """Half ranges of the uniform distributions; the defaults are those of the paper and its public code."""

    fixed_xy: float = 0.05
    """Position of the bolt or the holder on each axis, in m."""
    start_xy: float = 0.0
    """Position of the tool at the start on each horizontal axis, in m."""
    start_z: float = 0.0
    """Height of the tool at the start, in m."""


@dataclass(frozen=True)
class ScrewingRewardConfig:
    """Constants of the screwing tasks' dense reward, chosen by hand."""

    offset_gain: float = 20.0
    """Gain, in 1/m, on the distance from the fixed part's axis: 50 mm away the term is 1 - tanh(1)."""
    height_gain: float = 5.0
    """Gain, in 1/m, on the height over the first contact of the threads."""
    tilt_gain: float = 10.0
    """Gain, in 1/rad, on the held part's tilt."""


class ScrewingEnv(VisuotactileEnv):
    """A held part is screwed onto or into a fixed part: the hand turns it, lets go, turns back, and grasps it again.

    Subclasses define `screw` and `grip_indentation`.
    """

    Randomization = ScrewingRandomization
    reward_config = ScrewingRewardConfig()
    default_control_mode = "pd_ee_delta_pose_fixed_roll_pitch"
    physics_rate = 720  # at 240 a thread tilts and jams
    contacts = CONTACTS | dict(contact_offset=5e-5)  # m: threads have a tenth of a millimetre of play
    screw: Screw
    """Shapes of the held and the fixed part."""
    grip_indentation: float
    """Indentation of each gel under the grip, in m."""

    def _largest_ranges(self):
        lowest = self.screw.engaged + CLEAR
        return dict(
            fixed_xy=(MAX_XY, WRIST_END),
            start_xy=(MAX_XY, WRIST_END),
            start_z=(height_range(START_Z, lowest), "the threads would start in each other, or out of reach"),
        )

    def _load_task(self):
        self.held = self.screw.held.build(self.scene, "dynamic", sapien.Pose(BUILT_AT))
        self.fixed = self.screw.fixed.build(self.scene, "kinematic", sapien.Pose([*FIXED_XY, 0]))

    def _initialize_task(self, env_idx: torch.Tensor):
        n, ranges = len(env_idx), self.randomization
        fixed = torch.tensor([*FIXED_XY, 0.0]).repeat(n, 1)
        fixed[:, :2] += uniform_in(ranges.fixed_xy, n, 2)
        self.fixed.set_pose(Pose.create_from_pq(fixed))
        self._initialize_held(env_idx)

    def _initialize_held(self, env_idx: torch.Tensor) -> None:
        """Put the tool at its start, with the held part in it."""
        opening = self.screw.grip_width / 2 - self.grip_indentation
        start = self._start_tool(env_idx, START_Z, opening, self.screw.grip_force)
        self.held.set_pose(start * Pose.create_from_pq(q=torch.tensor([POINTING_DOWN])))

    def _start_tool(self, env_idx: torch.Tensor, height: float, opening: float, grip_force: float) -> Pose:
        """Put the tool, its wrist turned back by `WOUND_UP`, at random poses around a height, and return the poses (n,).

        Args:
            env_idx: Indices (n,) of the environments.
            height: Nominal height, in m.
            opening: Distance of each finger from the middle, in m.
            grip_force: Force, in N, of each finger on the object that it holds.
        """
        n, ranges = len(env_idx), self.randomization
        start = start_pose(n, (*FIXED_XY, height), (ranges.start_xy, ranges.start_xy, ranges.start_z), 0.0)
        wound = axis_angle_to_quaternion(torch.tensor([[0.0, 0.0, WOUND_UP]])).expand(n, 4)
        start = Pose.create_from_pq(start.p, quaternion_multiply(wound, start.q))
        self.agent.reset_tool(start, opening, grip_force, wrist_turn=-WOUND_UP)
        return start

    def measure(self) -> dict[str, torch.Tensor]:
        held = self.fixed.pose.inv() * self.held.pose
        up = quaternion_apply(held.q, held.q.new_tensor([0.0, 0.0, 1.0]).expand(self.num_envs, 3))
        return dict(
            descent=self.screw.engaged - held.p[:, 2],  # m, from where the threads first meet
            offset=torch.linalg.norm(held.p[:, :2], dim=1),  # m, from the fixed part's axis
            tilt=torch.acos(up[:, 2].clamp(-1.0, 1.0)),  # rad
            torque=-self.agent.torque_on_held(self.held.pose.p),  # N m, of the hand, clockwise seen from above
        )

    def failed(self, measures):
        away = torch.linalg.norm(self.agent.tcp.pose.p - self.held.pose.p, dim=1)
        return (away > LOST) & (measures["offset"] > OFF_AXIS)

    def shortcomings(self, measures):
        beside, above = measures["offset"] > OFF_AXIS, measures["descent"] <= 0.0
        return {"beside the axis": beside, "threads not engaged": above, "engaged, not tight": ~above}

    def _privileged_state(self):
        return dict(held_pose=self.held.pose.raw_pose, fixed_pose=self.fixed.pose.raw_pose)

    def compute_dense_reward(self, obs, action, info):
        """Reward in [0, 4]: 1 for the position over the axis, 1 for being upright there, 1 for depth, 1 for success."""
        gains = self.reward_config
        near = 1 - torch.tanh(gains.offset_gain * info["offset"] + gains.height_gain * (-info["descent"]).clamp(min=0.0))
        upright = near * (1 - torch.tanh(gains.tilt_gain * info["tilt"]))
        deep = (info["descent"] / (self.screw.engaged - self.screw.seated)).clamp(0.0, 1.0)
        return near + upright + deep * (info["offset"] < OFF_AXIS).float() + info["success"].float()
