"""The task ManiFeel-PegInsertion-v1."""

from manifeel_ms3.arguments import one_of
from manifeel_ms3.geometry import peg_fit
from manifeel_ms3.geometry.plugs import PEG_HOLES
from manifeel_ms3.tasks.registry import register_task

from .base import InsertionEnv


@register_task(
    "ManiFeel-PegInsertion-v1",
    max_episode_steps=220,
    category="insertion",
    paper_demos=50,
    paper_tables=("I",),
    demo_steps=83,
    force_limit=28.0,
)
class PegInsertionEnv(InsertionEnv):
    """Insert a rectangular peg into a socket with little clearance.

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

    max_gap = 1.0e-3

    def __init__(self, *args, fit: str = "tight", **kwargs):
        self.fit = peg_fit(one_of("fit", fit, PEG_HOLES))
        super().__init__(*args, **kwargs)
