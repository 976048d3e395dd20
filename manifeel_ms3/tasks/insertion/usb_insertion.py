"""The task ManiFeel-USBInsertion-v1."""

from manifeel_ms3.geometry import usb_fit
from manifeel_ms3.tasks.registry import register_task

from .base import InsertionEnv


@register_task(
    "ManiFeel-USBInsertion-v1",
    instruction="Insert the USB plug into the port.",
    max_episode_steps=240,
    category="insertion",
    paper_demos=50,
    paper_tables=("I",),
    demo_steps=57,
    revision=4,
    force_limit=31.0,
)
class USBInsertionEnv(InsertionEnv):
    """Insert a USB-A plug into a port that faces up.

    **Task Description:**
    The gripper holds a USB-A plug by its handle and puts it into a port that faces up. With `fit="paper"` plug and port are
    those of the paper's public code, 1.8 times the standard, with 0.7 mm of play on each side along the plug's width and 0.4 mm
    at the tongue; with `fit="tight"` they are the standard's, with 0.1 mm. The plug fits only one way round, which is the way
    it is held.

    **Randomizations:** (half ranges; the argument `randomization` overrides them)
    - port: xy +-50 mm around (0.5, 0) m
    - gripper start: 180 mm above the table, xy +-100 mm, z +-50 mm, +-0.1 rad about each axis
    - plug in hand: pitch about the closing axis +-10 degrees

    **Success Conditions:** held for 0.5 s
    - the shell has gone nine tenths of its way into the port
    - the plug is tilted by less than 3 degrees

    **Fail Conditions:** the plug has left the grip (30 mm).
    """

    _sample_video_link = "docs/videos/USBInsertion.mp4"
    make_fit = staticmethod(usb_fit)
    paper_threshold = 0.008
    lift = 0.03
