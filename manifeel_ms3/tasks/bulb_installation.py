"""ManiFeel-BulbInstallation-v1"""

from mani_skill.utils.registration import register_env

from manifeel_ms3.geometry import bulb_and_holder
from manifeel_ms3.geometry.screws import BULB_TRAVEL

from .screwing import ScrewingEnv

MAX_GAP = 0.5e-3  # m
TIGHT = 0.1  # N m


@register_env("ManiFeel-BulbInstallation-v1", max_episode_steps=500)
class BulbInstallationEnv(ScrewingEnv):
    """
    **Task Description:**
    The gripper holds a light bulb by its glass and screws its E27 cap (pitch 3.63 mm) into a holder that hides the thread,
    until it is tight. The hand turns 300 degrees at most; then it lets go, turns back, and takes the bulb again.

    **Randomizations:** (half ranges; the argument `randomization` overrides them)
    - holder: xy +-50 mm around (0.5, 0) m

    The gripper starts 150 mm above the table, wound up; the bulb's place in it is fixed.

    **Success Conditions:** held for 0.5 s
    - the cap is within 0.5 mm of the holder's contact
    - the hand tightens it with more than 0.1 N m

    **Fail Conditions:** the bulb is out of the hand (50 mm) and off the holder.
    """

    screw = bulb_and_holder()
    grip_indentation = 1.5e-3  # m: one contact point of 8 kN/m

    def measure(self):
        measures = super().measure()
        return measures | dict(gap=BULB_TRAVEL - measures["descent"])  # m, from the cap's foot to the holder's contact

    def goal_reached(self, measures):
        return (measures["gap"] < MAX_GAP) & (measures["offset"] < 2e-3) & (measures["torque"] > TIGHT)
