"""ManiFeel-PegInsertion-v1"""

from dataclasses import dataclass

import numpy as np
import sapien
import torch
from mani_skill.utils.geometry.rotation_conversions import axis_angle_to_quaternion, quaternion_apply
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose

from manifeel_ms3.geometry import rectangular_peg, rectangular_socket
from manifeel_ms3.geometry.pegs import HOLES, PEG_SIZE, SOCKET_DEPTH

from .placement import start_pose
from .visuotactile_env import VisuotactileEnv

SOCKET_XY = (0.5, 0.0)  # m, nominal
START_XYZ = (0.5, 0.0, 0.15)  # m, between the pads
GRIP_TO_CENTRE = 0.014  # m: the peg is held by its upper end, 21 mm stick out below the fingertips
GRIP_FORCE = 20.0  # N
GRIP_INDENTATION = 6e-4  # m: each gel under the grip of 20 N (four contact points of 8 kN/m)
MAX_GAP = 1.0e-3  # m, peg's end to socket floor
MAX_TILT = np.deg2rad(3.0)
LOST = 0.03  # m between peg and where it was held


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
    """rad, about each axis of the base"""
    in_hand_pitch: float = float(np.deg2rad(10))
    """rad, of the peg about the closing axis"""


@register_env("ManiFeel-PegInsertion-v1", max_episode_steps=300)
class PegInsertionEnv(VisuotactileEnv):
    """
    **Task Description:**
    The gripper holds a rectangular peg (11.96 x 7.91 x 50 mm) by its upper end and inserts it into a socket 9 mm deep.
    `fit="tight"` leaves 0.04 and 0.09 mm around the peg (the paper's part), `fit="loose"` 0.5 mm.

    **Randomizations:** (half ranges; the argument `randomization` overrides them)
    - socket: xy +-50 mm around (0.5, 0) m
    - gripper start: 150 mm above the table, xy +-100 mm, z +-50 mm, +-0.1 rad about each axis
    - peg in hand: pitch about the closing axis +-10 degrees

    **Success Conditions:** held for 0.5 s
    - the peg's end is in the hole, within 1 mm of its floor
    - the peg is tilted by less than 3 degrees

    **Fail Conditions:** the peg has left the grip (30 mm).
    """

    Randomization = Randomization

    def __init__(self, *args, fit: str = "tight", **kwargs):
        if fit not in HOLES:
            raise ValueError(f"fit={fit!r} is unknown; choose from {list(HOLES)}")
        self.fit = fit
        self.hole_size = HOLES[fit]
        super().__init__(*args, **kwargs)

    def _load_task(self):
        self.peg = rectangular_peg().build(self.scene, "dynamic", sapien.Pose([0.5, 0, 0.2]))
        self.socket = rectangular_socket(self.fit).build(self.scene, "kinematic", sapien.Pose([*SOCKET_XY, 0]))

    def _initialize_task(self, env_idx: torch.Tensor):
        n, ranges = len(env_idx), self.randomization
        socket = torch.tensor([*SOCKET_XY, 0.0]).repeat(n, 1)
        socket[:, :2] += (2 * torch.rand(n, 2) - 1) * ranges.socket_xy
        self.socket.set_pose(Pose.create_from_pq(socket))

        start = start_pose(n, START_XYZ, (ranges.start_xy, ranges.start_xy, ranges.start_z), ranges.start_rotation)
        qpos = torch.tensor(self.agent.keyframes["tool_down"].qpos, dtype=torch.float32).repeat(n, 1)
        qpos[:, :7] = self.agent.solve_ik(start, qpos)
        qpos[:, 7:] = PEG_SIZE[1] / 2 - GRIP_INDENTATION
        self.agent.reset(qpos, GRIP_FORCE)

        pitch = torch.zeros(n, 3)
        pitch[:, 1] = (2 * torch.rand(n) - 1) * ranges.in_hand_pitch
        in_hand = Pose.create_from_pq(q=axis_angle_to_quaternion(pitch)) * self._grip
        self.peg.set_pose(start * in_hand)

    @property
    def _grip(self) -> Pose:
        """Peg in the tool frame at zero pitch."""
        return Pose.create_from_pq(torch.tensor([[0.0, 0.0, GRIP_TO_CENTRE]], device=self.device))

    def measure(self) -> dict[str, torch.Tensor]:
        peg = self.socket.pose.inv() * self.peg.pose
        along = quaternion_apply(peg.q, peg.q.new_tensor([0.0, 0.0, 1.0]).expand(self.num_envs, 3))
        along = along * torch.sign(along[:, 2:])  # up
        end = peg.p - along * PEG_SIZE[2] / 2
        return dict(
            gap=end[:, 2],  # m, of the peg's end above the hole's floor
            offset=torch.linalg.norm(end[:, :2], dim=1),  # m, of the peg's end from the hole's axis
            tilt=torch.acos(along[:, 2].clamp(-1.0, 1.0)),  # rad
        )

    def goal_reached(self, measures):
        inside = measures["offset"] < 1.0e-3  # both fits hold the peg closer than this
        return inside & (measures["gap"] < MAX_GAP) & (measures["tilt"] < MAX_TILT)

    def failed(self, measures):
        held = self.agent.tcp.pose.inv() * self.peg.pose
        return torch.linalg.norm(held.p - self._grip.p, dim=1) > LOST

    def _privileged_state(self):
        return dict(peg_pose=self.peg.pose.raw_pose, socket_pose=self.socket.pose.raw_pose)

    def compute_dense_reward(self, obs, action, info):
        """In [0, 4]: 1 for coming over the hole, 1 for being upright there, 1 for depth, 1 for success."""
        near = 1 - torch.tanh(20 * info["offset"] + 5 * (info["gap"] - SOCKET_DEPTH).clamp(min=0.0))
        upright = near * (1 - torch.tanh(10 * info["tilt"]))
        inserted = ((SOCKET_DEPTH - info["gap"]) / (SOCKET_DEPTH - MAX_GAP)).clamp(0.0, 1.0)
        inside = (info["offset"] < 5.0e-3).float()  # beside the socket, lower is not better
        return near + upright + inserted * inside + info["success"].float()

    def compute_normalized_dense_reward(self, obs, action, info):
        return self.compute_dense_reward(obs, action, info) / 4.0
