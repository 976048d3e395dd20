"""The task ManiFeel-NutBoltAssembly-v1."""

import numpy as np

from manifeel_ms3.geometry import nut_and_bolt
from manifeel_ms3.tasks.registry import register_task

from .base import ScrewingEnv

ON_AXIS = 1.0e-3
"""Largest distance of the nut from the bolt's axis, in m, at success. Our choice."""
MAX_TILT = np.deg2rad(2.0)
"""Largest angle, in rad, between the axes of nut and bolt at success. Our choice."""


@register_task(
    "ManiFeel-NutBoltAssembly-v1",
    instruction="Screw the nut onto the bolt.",
    max_episode_steps=1080,
    category="screwing",
    paper_demos=30,
    paper_tables=("I",),
    demo_megabytes=110.0,
    demo_steps=404,
    revision=4,
    force_limit=24.0,
)
class NutBoltAssemblyEnv(ScrewingEnv):
    """Screw an M16 nut onto a bolt.

    **Task Description:**
    The gripper holds an M16 nut and screws it onto a bolt that stands up. Both have real threads with a pitch of 2 mm. The
    hand turns 310 degrees at most; then it lets go, turns back, and takes the nut again.

    **Randomizations:** (half ranges; the argument `randomization` overrides them)
    - bolt: xy +-50 mm around (0.5, 0) m

    The gripper starts 120 mm above the table, its wrist turned back by 200 degrees; the nut's place in it is fixed.

    **Success Conditions:** held for 0.5 s
    - the nut is 1.5 pitches down from where the threads first meet
    - it is square to the bolt (2 degrees) and on its axis (1 mm)

    **Fail Conditions:** the nut is out of the hand (50 mm) and off the bolt.
    """

    _sample_video_link = "docs/videos/NutBoltAssembly.mp4"
    screw = nut_and_bolt()
    grip_indentation = 8e-4  # m: four contact points of 8 kN/m

    def goal_reached(self, measures):
        on = (measures["offset"] < ON_AXIS) & (measures["tilt"] < MAX_TILT)
        return on & (measures["descent"] > self.screw.engaged - self.screw.seated)
