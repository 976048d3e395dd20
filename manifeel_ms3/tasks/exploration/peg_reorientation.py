"""The task ManiFeel-PegReorientation-v1."""

from dataclasses import dataclass

import numpy as np
import sapien
import torch
from mani_skill.utils.geometry.rotation_conversions import quaternion_apply
from mani_skill.utils.structs import Pose

from manifeel_ms3.geometry import reorientation_fit
from manifeel_ms3.geometry.containers import open_box
from manifeel_ms3.tasks.insertion.base import CLEAR, SOCKET_XY, START_XYZ, InsertionEnv, InsertionRandomization
from manifeel_ms3.tasks.placement import height_range
from manifeel_ms3.tasks.registry import register_task
from manifeel_ms3.tasks.viewpoints import FAR_FRONT_CAMERA_AT, FAR_SIDE_CAMERA_AT

BOX_OUTER, BOX_HEIGHT = (0.24, 0.26), 0.09
"""Outer size of the box along x and y, and its height, in m: it hides the rim from the front camera."""
MAX_HAND_TILT = np.deg2rad(5.0)
"""Angle, in rad, from the vertical below which the hand counts as upright. Our choice."""
MAX_IN_HAND = np.deg2rad(3.0)
"""Angle, in rad, between the peg and the hand below which the peg counts as turned. Our choice."""
MAX_YAW = 1.0
"""Largest half range of the tool's rotation about the vertical, in rad, that keeps the last joint of the arm off
its limits."""


@dataclass(frozen=True)
class PegReorientationRandomization(InsertionRandomization):
    """Half ranges of the uniform distributions; the defaults are those of the paper's public code."""

    socket_xy: float = 0.0
    """Position of the box and its rim on each axis, in m."""
    start_rotation: float = 0.05
    """Rotation of the tool at the start about each horizontal axis of the robot's base, in rad."""
    start_yaw: float = 0.5
    """Rotation of the tool at the start about the vertical, in rad."""
    in_hand_pitch: float = float(np.deg2rad(30))
    """Pitch of the peg in the hand about the closing axis, in rad."""


@register_task(
    "ManiFeel-PegReorientation-v1",
    instruction="Turn the peg in the hand until it is upright, and insert it into the hole in the box.",
    max_episode_steps=360,
    category="exploration",
    paper_demos=50,
    paper_tables=("I",),
    revision=3,
    demo_megabytes=26.0,
    demo_steps=135,
    force_limit=38.0,
)
class PegReorientationEnv(InsertionEnv):
    """Turn a tilted peg in the hand against a rim that the camera cannot see, and insert it.

    **Task Description:**
    The gripper holds a peg, 16 x 10 x 50 mm, at an angle, over a rim in an opaque box that the policy's camera cannot see into.
    The gripper cannot open. It pushes the peg against the rim until the peg stands upright in the hand, and puts it in.

    **Randomizations:** (half ranges, of the paper's public code; the argument `randomization` overrides them)
    - gripper start: 220 mm above the table, xy +-100 mm, z +-50 mm, +-0.05 rad about x and y, +-0.5 rad about the vertical
    - peg in hand: pitch about the closing axis +-30 degrees

    **Success Conditions:** held for 0.5 s
    - the peg fills at least 90 % of the depth of the rim
    - the peg is tilted by less than 3 degrees, and the hand by less than 5 degrees
    - the angle between the peg and the hand is less than 3 degrees: a hand that tilts instead of turning the peg fails

    **Fail Conditions:** the peg has left the grip (30 mm).

    `occlusion=False` leaves the box's front undrawn.
    """

    _sample_video_link = "docs/videos/PegReorientation.mp4"
    Randomization = PegReorientationRandomization
    policy_cameras = ("front",)
    has_occluder = True
    front_camera_at = FAR_FRONT_CAMERA_AT
    side_camera_at = FAR_SIDE_CAMERA_AT
    fits = ("paper",)
    paper_threshold = 0.03
    lift = 0.07

    @staticmethod
    def make_fit(fit):
        return reorientation_fit()

    def _largest_ranges(self):
        lowest = BOX_HEIGHT + CLEAR + self.fit.reach - self.fit.grip
        start_z = height_range(START_XYZ[2] + self.lift, lowest)
        return super()._largest_ranges() | dict(
            start_z=(start_z, "the peg would start in the box, or out of reach"),
            start_yaw=(MAX_YAW, "the hand would reach the end of a joint"),
        )

    @property
    def _start_rotation(self):
        ranges = self.randomization
        return torch.tensor([ranges.start_rotation, ranges.start_rotation, ranges.start_yaw])

    def _load_task(self):
        super()._load_task()
        kind = "kinematic" if self.randomization.socket_xy > 0 else "static"  # a static body cannot be moved on a GPU
        self.box = open_box(BOX_OUTER, BOX_HEIGHT, self.occlusion).build(self.scene, kind, sapien.Pose([*SOCKET_XY, 0]))

    def _initialize_task(self, env_idx):
        super()._initialize_task(env_idx)
        if self.randomization.socket_xy > 0:
            place = self.socket.pose.p[env_idx]
            place[:, 2] = 0.0
            self.box.set_pose(Pose.create_from_pq(place))

    def measure(self):
        tool = self.agent.tcp.pose
        ahead = torch.tensor([0.0, 0.0, 1.0], device=self.device).expand(self.num_envs, 3)
        fingers, peg = quaternion_apply(tool.q, ahead), quaternion_apply(self.plug.pose.q, ahead)
        return super().measure() | dict(
            hand_tilt=torch.acos(-fingers[:, 2].clamp(-1.0, 1.0)),  # rad, of the fingers from the vertical
            in_hand=torch.acos((fingers * peg).sum(1).clamp(-1.0, 1.0)),  # rad, between the fingers and the peg's axis
        )

    def shortcomings(self, measures):
        return {"peg not turned in the hand": measures["in_hand"] >= MAX_IN_HAND} | super().shortcomings(measures)

    def goal_reached(self, measures):
        turned = (measures["hand_tilt"] < MAX_HAND_TILT) & (measures["in_hand"] < MAX_IN_HAND)
        return super().goal_reached(measures) & turned
