"""The task ManiFeel-PowerPlugInsertion-v1."""

from manifeel_ms3.geometry import power_fit
from manifeel_ms3.geometry.plugs import BLADE
from manifeel_ms3.tasks.registry import register_task

from .base import InsertionEnv

NOT_INSERTED = 0.1
"""Share of the blades' length that may be outside the socket at success."""


@register_task(
    "ManiFeel-PowerPlugInsertion-v1",
    max_episode_steps=190,
    category="insertion",
    paper_demos=50,
    paper_tables=("I",),
    demo_steps=92,
    force_limit=24.0,
)
class PowerPlugInsertionEnv(InsertionEnv):
    """Insert a NEMA 5-15 plug into a socket that looks up.

    **Task Description:**
    The gripper holds a NEMA 5-15 plug and puts its two blades and its ground pin into a socket that looks up. The holes leave
    0.2 mm on each side; the ground pin, 3 mm longer than the blades, finds its hole first.

    **Randomizations:** (half ranges; the argument `randomization` overrides them)
    - socket: xy +-50 mm around (0.5, 0) m
    - gripper start: 180 mm above the table, xy +-100 mm, z +-50 mm, +-0.1 rad about each axis
    - plug in hand: pitch about the closing axis +-10 degrees

    **Success Conditions:** held for 0.5 s
    - at least 90 % of the blades is in the socket
    - the plug is tilted by less than 3 degrees

    **Fail Conditions:** the plug has left the grip (30 mm).
    """

    fit = power_fit()
    max_gap = NOT_INSERTED * BLADE[2]
    lift = 0.03
