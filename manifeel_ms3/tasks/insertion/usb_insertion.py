"""The task ManiFeel-USBInsertion-v1."""

from manifeel_ms3.geometry import usb_fit
from manifeel_ms3.tasks.registry import register_task

from .base import InsertionEnv

NOT_INSERTED = 0.1
"""Share of the shell that may be outside the port at success."""


@register_task(
    "ManiFeel-USBInsertion-v1",
    max_episode_steps=160,
    category="insertion",
    paper_demos=50,
    paper_tables=("I",),
    demo_steps=78,
    force_limit=30.0,
)
class USBInsertionEnv(InsertionEnv):
    """Insert a USB-A plug into a port that looks up.

    **Task Description:**
    The gripper holds a USB-A plug by its handle and puts it into a port that looks up. Shell and tongue have 0.1 mm around them
    on each side; the plug fits only one way round, which is the way it is held.

    **Randomizations:** (half ranges; the argument `randomization` overrides them)
    - port: xy +-50 mm around (0.5, 0) m
    - gripper start: 180 mm above the table, xy +-100 mm, z +-50 mm, +-0.1 rad about each axis
    - plug in hand: pitch about the closing axis +-10 degrees

    **Success Conditions:** held for 0.5 s
    - at least 90 % of the shell is in the port
    - the plug is tilted by less than 3 degrees

    **Fail Conditions:** the plug has left the grip (30 mm).
    """

    fit = usb_fit()
    max_gap = NOT_INSERTED * fit.depth
    lift = 0.03
