"""The task ManiFeel-PowerPlugInsertion-v1."""

from manifeel_ms3.geometry import power_fit
from manifeel_ms3.tasks.registry import register_task

from .base import InsertionEnv


@register_task(
    "ManiFeel-PowerPlugInsertion-v1",
    instruction="Insert the power plug into the socket.",
    max_episode_steps=240,
    category="insertion",
    paper_demos=50,
    paper_tables=("I",),
    demo_steps=58,
    revision=4,
    force_limit=32.0,
)
class PowerPlugInsertionEnv(InsertionEnv):
    """Insert a NEMA 5-15 plug into a socket that faces up.

    **Task Description:**
    The gripper holds a NEMA 5-15 plug and puts its two blades and its ground pin into a socket that faces up. With
    `fit="paper"` plug and socket are those of the paper's public code, 1.8 times the standard, with 0.5 to 0.8 mm of play on
    each side; with `fit="tight"` they are the standard's, with 0.2 mm. The ground pin, longer than the blades, finds its hole
    first.

    **Randomizations:** (half ranges; the argument `randomization` overrides them)
    - socket: xy +-50 mm around (0.5, 0) m
    - gripper start: 180 mm above the table, xy +-100 mm, z +-50 mm, +-0.1 rad about each axis
    - plug in hand: pitch about the closing axis +-10 degrees

    **Success Conditions:** held for 0.5 s
    - the blades are inserted to within a tenth of their length of the final position
    - the plug is tilted by less than 3 degrees

    **Fail Conditions:** the plug has left the grip (30 mm).
    """

    _sample_video_link = "docs/videos/PowerPlugInsertion.mp4"
    make_fit = staticmethod(power_fit)
    paper_threshold = 0.007
    lift = 0.03
