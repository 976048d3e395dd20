"""The task ManiFeel-PegInsertion-v1."""

from manifeel_ms3.geometry import peg_fit
from manifeel_ms3.tasks.registry import register_task

from .base import InsertionEnv


@register_task(
    "ManiFeel-PegInsertion-v1",
    instruction="Insert the peg into the hole.",
    max_episode_steps=240,
    category="insertion",
    paper_demos=50,
    paper_tables=("I",),
    demo_steps=55,
    revision=4,
    force_limit=36.0,
)
class PegInsertionEnv(InsertionEnv):
    """Insert a rectangular peg into a socket.

    **Task Description:**
    The gripper holds a rectangular peg (11.96 x 7.91 x 50 mm) by its upper end and inserts it into a socket. With `fit="paper"`
    the socket is that of the paper's public code: 13 x 9 mm, 25 mm deep, with a chamfer of 1 mm. With `fit="tight"` it is
    12 x 8 mm, 9 mm deep, without a chamfer.

    **Randomizations:** (half ranges; the argument `randomization` overrides them)
    - socket: xy +-50 mm around (0.5, 0) m
    - gripper start: 150 mm above the table, xy +-100 mm, z +-50 mm, +-0.1 rad about each axis
    - peg in hand: pitch about the closing axis +-10 degrees

    **Success Conditions:** held for 0.5 s
    - the peg's end is in the hole, within 1 mm of its floor
    - the peg is tilted by less than 3 degrees

    **Fail Conditions:** the peg has left the grip (30 mm).
    """

    _sample_video_link = "docs/videos/PegInsertion.mp4"
    make_fit = staticmethod(peg_fit)
    paper_threshold = 0.009
