"""What the insertion tasks share: a held plug, a socket on the table, and the plug's foremost face on the way to its floor."""

from dataclasses import dataclass

import numpy as np
import sapien
import torch
from mani_skill.utils.geometry.rotation_conversions import axis_angle_to_quaternion, quaternion_apply
from mani_skill.utils.structs import Pose

from manifeel_ms3.geometry import Fit
from manifeel_ms3.tasks.placement import OUT_OF_REACH, REACH_XY, height_range, start_pose
from manifeel_ms3.tasks.visuotactile_env import VisuotactileEnv

SOCKET_XY = (0.5, 0.0)  # m, nominal
START_XYZ = (0.5, 0.0, 0.15)  # m, between the pads
GRIP_FORCE = 20.0  # N
GRIP_INDENTATION = 6e-4  # m: each gel under the grip of 20 N (four contact points of 8 kN/m)
MAX_TILT = np.deg2rad(3.0)
LOST = 0.03  # m between plug and where it was held
CLEAR = 0.010  # m over the socket, of a plug at the start
MAX_ROTATION, MAX_PITCH = 0.4, 0.8  # rad
BESIDE = 0.005  # m off the axis: lower is not better there


@dataclass
class Randomization:
    """Half ranges of the uniform distributions; the defaults are the paper's."""

    socket_xy: float = 0.05
    """m, each axis"""
    start_xy: float = 0.10
    """m, each axis"""
    start_z: float = 0.05
    """m"""
    start_rotation: float = 0.1
    """rad, about each axis of the robot's base"""
    in_hand_pitch: float = float(np.deg2rad(10))
    """rad, of the plug about the closing axis"""


class InsertionEnv(VisuotactileEnv):
    """A held plug is put into a socket.

    Subclasses set `fit` before they call this constructor, `max_gap`, the distance from the floor that counts as in, and
    `lift`, how much higher than 150 mm the tool starts.
    """

    Randomization = Randomization
    fit: Fit
    max_gap: float
    lift: float = 0.0

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
        self.plug = self.fit.plug.build(self.scene, "dynamic", sapien.Pose([0.5, 0, 0.3], [0, 1, 0, 0]))
        self.socket = self.fit.socket.build(self.scene, "kinematic", sapien.Pose([*SOCKET_XY, 0]))

    def _initialize_task(self, env_idx: torch.Tensor):
        n, ranges = len(env_idx), self.randomization
        socket = torch.tensor([*SOCKET_XY, 0.0]).repeat(n, 1)
        socket[:, :2] += (2 * torch.rand(n, 2) - 1) * ranges.socket_xy
        self.socket.set_pose(Pose.create_from_pq(socket))

        position = (*START_XYZ[:2], START_XYZ[2] + self.lift)
        start = start_pose(n, position, (ranges.start_xy, ranges.start_xy, ranges.start_z), ranges.start_rotation)
        self.agent.reset_tool(start, self.fit.grip_width / 2 - GRIP_INDENTATION, GRIP_FORCE)

        pitch = torch.zeros(n, 3)
        pitch[:, 1] = (2 * torch.rand(n) - 1) * ranges.in_hand_pitch
        in_hand = Pose.create_from_pq(q=axis_angle_to_quaternion(pitch)) * self._grip
        self.plug.set_pose(start * in_hand)

    @property
    def _grip(self) -> Pose:
        """Plug in the tool's frame at zero pitch."""
        return Pose.create_from_pq(torch.tensor([[0.0, 0.0, -self.fit.grip]], device=self.device))

    def measure(self) -> dict[str, torch.Tensor]:
        plug = self.socket.pose.inv() * self.plug.pose
        ahead = quaternion_apply(plug.q, plug.q.new_tensor([0.0, 0.0, 1.0]).expand(self.num_envs, 3))
        end = plug.p + ahead * self.fit.reach
        return dict(
            gap=end[:, 2] - self.fit.floor,  # m, of the plug's foremost face over the floor
            offset=torch.linalg.norm(end[:, :2], dim=1),  # m, of that face's middle from the socket's axis
            tilt=torch.acos(-ahead[:, 2].clamp(-1.0, 1.0)),  # rad
        )

    def goal_reached(self, measures):
        inside = measures["offset"] < self.fit.clearance
        return inside & (measures["gap"] < self.max_gap) & (measures["tilt"] < MAX_TILT)

    def failed(self, measures):
        held = self.agent.tcp.pose.inv() * self.plug.pose
        return torch.linalg.norm(held.p - self._grip.p, dim=1) > LOST

    def _privileged_state(self):
        return dict(plug_pose=self.plug.pose.raw_pose, socket_pose=self.socket.pose.raw_pose)

    def compute_dense_reward(self, obs, action, info):
        """In [0, 4]: 1 for coming over the hole, 1 for being upright there, 1 for depth, 1 for success."""
        depth = self.fit.depth
        near = 1 - torch.tanh(20 * info["offset"] + 5 * (info["gap"] - depth).clamp(min=0.0))
        upright = near * (1 - torch.tanh(10 * info["tilt"]))
        inserted = ((depth - info["gap"]) / (depth - self.max_gap)).clamp(0.0, 1.0)
        return near + upright + inserted * (info["offset"] < BESIDE).float() + info["success"].float()
