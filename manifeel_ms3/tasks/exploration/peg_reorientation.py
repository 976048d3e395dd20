"""The task ManiFeel-PegReorientation-v1."""

from dataclasses import dataclass

import numpy as np
import sapien

from manifeel_ms3.geometry import reorientation_fit
from manifeel_ms3.geometry.containers import open_box
from manifeel_ms3.tasks.insertion.base import SOCKET_XY, InsertionEnv, InsertionRandomization
from manifeel_ms3.tasks.registry import register_task

BOX_OUTER, BOX_HEIGHT = (0.24, 0.26), 0.09  # m
NOT_INSERTED = 0.1
"""Share of the rim's depth that the peg may leave at success."""


@dataclass(frozen=True)
class PegReorientationRandomization(InsertionRandomization):
    """Half ranges of the uniform distributions; the defaults are the paper's, which fixes the place of the rim."""

    socket_xy: float = 0.0
    start_xy: float = 0.03
    start_z: float = 0.02
    start_rotation: float = 0.05
    in_hand_pitch: float = float(np.deg2rad(30))


@register_task(
    "ManiFeel-PegReorientation-v1",
    max_episode_steps=150,
    category="exploration",
    paper_demos=50,
    paper_tables=("I",),
    demo_steps=74,
    force_limit=25.0,
)
class PegReorientationEnv(InsertionEnv):
    """Stand a tilted peg up in a rim that the camera cannot see.

    **Task Description:**
    The gripper holds a peg, 16 x 10 x 50 mm, at an angle, over a rim in an opaque box that the policy's camera cannot see into.
    It finds the rim, stands the peg up in it and presses it in.

    **Randomizations:** (half ranges; the argument `randomization` overrides them)
    - gripper start: 200 mm above the table, xy +-30 mm, z +-20 mm, +-0.05 rad about each axis
    - peg in hand: pitch about the closing axis +-30 degrees

    **Success Conditions:** held for 0.5 s
    - at least 90 % of the rim's depth is taken
    - the peg is tilted by less than 3 degrees

    **Fail Conditions:** the peg has left the grip (30 mm).

    `occlusion=False` leaves the box's front undrawn.
    """

    Randomization = PegReorientationRandomization
    policy_cameras = ("front",)
    has_occluder = True
    front_camera_at = (0.80, 0.0, 0.15)
    fit = reorientation_fit()
    max_gap = NOT_INSERTED * fit.depth
    lift = 0.05

    def _load_task(self):
        super()._load_task()
        self.box = open_box(BOX_OUTER, BOX_HEIGHT, self.occlusion).build(self.scene, "static", sapien.Pose([*SOCKET_XY, 0]))
