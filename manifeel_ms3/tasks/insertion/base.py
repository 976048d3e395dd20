"""The base class of the insertion tasks, in which a held plug is put into a socket on the table."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import sapien
import torch
from mani_skill.utils.geometry.rotation_conversions import quaternion_apply
from mani_skill.utils.structs import Pose

from manifeel_ms3.arguments import one_of
from manifeel_ms3.geometry import FITS, Fit
from manifeel_ms3.tasks.placement import (
    BUILT_AT,
    OUT_OF_REACH,
    POINTING_DOWN,
    REACH_XY,
    WORKSPACE_XY,
    height_range,
    start_pose,
    turned_about,
    uniform_in,
)
from manifeel_ms3.tasks.visuotactile_env import VisuotactileEnv

SOCKET_XY = WORKSPACE_XY
"""Nominal position of the socket, in m."""
START_XYZ = (*WORKSPACE_XY, 0.15)
"""Nominal position of the tool, in m, at the start (public code of the paper)."""
GRIP_FORCE = 20.0
"""Force of each pad on the plug, in N. Set once; not tuned."""
GRIP_INDENTATION = 6e-4
"""Indentation of each gel under the grip of 20 N, in m: four contact points of 8 kN/m."""
MAX_TILT = np.deg2rad(3.0)
"""Angle, in rad, from the socket's axis below which the plug counts as upright. Our choice."""
LOST = 0.03
"""Displacement of the plug in the grip, in m, beyond which it is lost. Our choice."""
BESIDE = 0.003
"""Distance, in m, of the plug's end from the socket's axis beyond which it is beside the hole and not in it.
Our choice."""
CLEAR = 0.010
"""Smallest height of the plug over the socket at the start, in m. Set once; not tuned."""
MAX_ROTATION = 0.4
"""Largest half range of the tool's rotation, in rad, that keeps the hand off the table and its joints off their limits."""
KEY_POINTS = (-0.25, -0.25 / 3, 0.25 / 3, 0.25)
"""Places of the key points along the plug's axis, in m from its foremost face: four on a line of 0.5 m (public code)."""
MAX_PITCH = 0.8
"""Largest half range of the plug's pitch in the hand, in rad: beyond it, the plug would lie across the fingers."""


@dataclass(frozen=True)
class InsertionRandomization:
    """Half ranges of the uniform distributions; the defaults are those of the paper and its public code."""

    socket_xy: float = 0.05
    """Position of the socket on each axis, in m."""
    start_xy: float = 0.10
    """Position of the tool at the start on each horizontal axis, in m."""
    start_z: float = 0.05
    """Height of the tool at the start, in m."""
    start_rotation: float = 0.1
    """Rotation of the tool at the start about each axis of the robot's base, in rad."""
    in_hand_pitch: float = float(np.deg2rad(10))
    """Pitch of the plug in the hand about the closing axis, in rad."""


@dataclass(frozen=True)
class InsertionRewardConfig:
    """Constants of the insertion tasks' dense reward, chosen by hand."""

    offset_gain: float = 20.0
    """Gain, in 1/m, on the distance from the socket's axis: 50 mm away the term is 1 - tanh(1)."""
    height_gain: float = 5.0
    """Gain, in 1/m, on the height over the rim."""
    tilt_gain: float = 10.0
    """Gain, in 1/rad, on the plug's tilt."""
    beside: float = 0.005
    """Distance from the socket's axis, in m, beyond which depth is not rewarded: the plug is beside the hole there."""


class InsertionEnv(VisuotactileEnv):
    """A held plug is put into a socket.

    Subclasses define `make_fit`.

    Args:
        args: Positional arguments of `VisuotactileEnv`.
        fit: Sizes of plug and socket, one of `fits`.
        kwargs: Other arguments of `VisuotactileEnv`.

    Raises:
        InvalidArgumentError: The fit is not one of `fits`; or as `VisuotactileEnv`.
    """

    Randomization = InsertionRandomization
    reward_config = InsertionRewardConfig()
    fits: ClassVar[tuple[str, ...]] = FITS
    """Names of the sizes that the parts come in."""
    lift: float = 0.0
    """Height that is added to the tool's start, in m, where long parts would otherwise start in each other."""
    paper_threshold: float
    """Mean distance of the key points, in m, below which the paper's public code counts a success."""

    def __init__(self, *args, fit: str = "paper", **kwargs):
        self.fit_name = one_of("fit", fit, self.fits)
        self.fit = self.make_fit(self.fit_name)
        super().__init__(*args, **kwargs)

    @staticmethod
    def make_fit(fit: str) -> Fit:
        """Shapes of plug and socket in the sizes that have this name, one of `fits`."""
        raise NotImplementedError

    def _largest_ranges(self):
        lowest = self.fit.rim + CLEAR + self.fit.reach - self.fit.grip
        return dict(
            socket_xy=(REACH_XY, OUT_OF_REACH),
            start_xy=(REACH_XY, OUT_OF_REACH),
            start_z=(height_range(START_XYZ[2] + self.lift, lowest), "the plug would start in the socket, or out of reach"),
            start_rotation=(MAX_ROTATION, "the hand would reach the table, or the end of a joint"),
            in_hand_pitch=(MAX_PITCH, "the plug would lie across the fingers"),
        )

    def _load_task(self):
        self.plug = self.fit.plug.build(self.scene, "dynamic", sapien.Pose(BUILT_AT, POINTING_DOWN))
        self.socket = self.fit.socket.build(self.scene, "kinematic", sapien.Pose([*SOCKET_XY, 0]))

    def _initialize_task(self, env_idx: torch.Tensor):
        n, ranges = len(env_idx), self.randomization
        socket = torch.tensor([*SOCKET_XY, 0.0]).repeat(n, 1)
        socket[:, :2] += uniform_in(ranges.socket_xy, n, 2)
        self.socket.set_pose(Pose.create_from_pq(socket))

        position = (*START_XYZ[:2], START_XYZ[2] + self.lift)
        start = start_pose(n, position, (ranges.start_xy, ranges.start_xy, ranges.start_z), self._start_rotation)
        self.agent.reset_tool(start, self.fit.grip_width / 2 - GRIP_INDENTATION, GRIP_FORCE)

        pitch = turned_about(1, uniform_in(ranges.in_hand_pitch, n))
        in_hand = Pose.create_from_pq(q=pitch) * self._grip
        self.plug.set_pose(start * in_hand)

    @property
    def _start_rotation(self) -> float | torch.Tensor:
        """Half range of the tool's rotation at the start, in rad, about every axis of the base frame, or about each (3,)."""
        return self.randomization.start_rotation

    @property
    def _grip(self) -> Pose:
        """Pose of the plug in the tool's frame at zero pitch."""
        return Pose.create_from_pq(torch.tensor([[0.0, 0.0, -self.fit.grip]], device=self.device))

    def measure(self) -> dict[str, torch.Tensor]:
        plug = self.socket.pose.inv() * self.plug.pose
        ahead = quaternion_apply(plug.q, plug.q.new_tensor([0.0, 0.0, 1.0]).expand(self.num_envs, 3))
        end = plug.p + ahead * self.fit.reach
        lag = end - end.new_tensor([0.0, 0.0, self.fit.floor])  # (N, 3), m: from the foremost face's place to where it is
        turn = ahead - ahead.new_tensor([0.0, 0.0, -1.0])
        key_points = lag[:, None] + turn[:, None] * lag.new_tensor(KEY_POINTS)[:, None]  # (N, 4, 3), m
        return dict(
            gap=lag[:, 2],  # m, of the plug's foremost face over its place at the floor
            offset=torch.linalg.norm(end[:, :2], dim=1),  # m, of that face's middle from the socket's axis
            tilt=torch.acos(-ahead[:, 2].clamp(-1.0, 1.0)),  # rad
            keypoint_distance=torch.linalg.norm(key_points, dim=-1).mean(dim=-1),  # m
        )

    def goal_reached(self, measures):
        inside = measures["offset"] < self.fit.clearance
        return inside & (measures["gap"] < self.fit.max_gap) & (measures["tilt"] < MAX_TILT)

    def paper_goal_reached(self, measures):
        return measures["keypoint_distance"] < self.paper_threshold

    def failed(self, measures):
        held = self.agent.tcp.pose.inv() * self.plug.pose
        return torch.linalg.norm(held.p - self._grip.p, dim=1) > LOST

    def shortcomings(self, measures):
        outside = (measures["gap"] >= self.fit.depth) | (measures["offset"] >= BESIDE)
        too_high = ~outside & (measures["gap"] >= self.fit.max_gap)
        at_bottom = ~outside & ~too_high
        return {
            "beside or above the hole": outside,
            "in the hole, not pressed home": too_high,
            "pressed home, not upright or not for long enough": at_bottom,
        }

    def _privileged_state(self):
        return dict(plug_pose=self.plug.pose.raw_pose, socket_pose=self.socket.pose.raw_pose)

    def compute_dense_reward(self, obs, action, info):
        """Reward in [0, 4]: 1 for the position over the hole, 1 for being upright there, 1 for depth, 1 for success."""
        depth, gains = self.fit.depth, self.reward_config
        near = 1 - torch.tanh(gains.offset_gain * info["offset"] + gains.height_gain * (info["gap"] - depth).clamp(min=0.0))
        upright = near * (1 - torch.tanh(gains.tilt_gain * info["tilt"]))
        inserted = ((depth - info["gap"]) / (depth - self.fit.max_gap)).clamp(0.0, 1.0)
        return near + upright + inserted * (info["offset"] < gains.beside).float() + info["success"].float()
