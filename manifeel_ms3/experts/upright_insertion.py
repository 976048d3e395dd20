"""Demonstrator of a fit with play: come over the hole upright, lower, slide to where the contact says, press."""

from dataclasses import dataclass

import numpy as np

from manifeel_ms3.tasks.insertion.base import InsertionEnv
from manifeel_ms3.tasks.registry import register_demonstrator

from .insertion import STRAIGHT, InsertionExpert, InsertionExpertConfig
from .leaning_insertion import LeaningGearExpert, LeaningInsertionExpert
from .skills import Actions, above


@dataclass(frozen=True)
class UprightConfig(InsertionExpertConfig):
    """Constants of the demonstrator that lowers the plug upright.

    Values without another origin were tuned by hand; docs/tasks.md has the success of every task over seeds 0 to 99.
    """

    keeps_hand: bool = True
    lowering: float = 0.003
    """Depth below the rim, in m, down to which the plug is lowered at a steady pace where nothing stops it. Tuned."""
    slide: float = 3e-4
    """Motion of the plug away from what it stands on, in m per step. Tuned."""
    sure_force: float = 1.5
    """Downward force, in N, from which the place of a contact can be told. Tuned."""
    unload_every: int = 10
    """Number of steps between changes of the force on a gear whose teeth stand on others. Tuned."""
    light_press: float = 1.0
    """The smaller of these forces, in N. Tuned."""
    centred: float = 0.0008
    """Distance of the contact from the middle, in m, below which it says no direction. Tuned."""


class UprightInsertionExpert(InsertionExpert):
    """Does what a person does with half a millimetre of play.

    It comes over the hole upright, lowers the plug, and presses. Where the plug stands on an edge, the force comes from the
    side on which it overlaps; it slides away from there. In the hole it gives way to the walls. Each action depends on what is
    seen and felt at that moment, so that a policy without memory can do the same.
    """

    config = UprightConfig()

    def _enter(self) -> Actions:
        over = np.array([*self.socket[:2], self._rim])
        start, facing = self._tool_for(self._end, above(over, self.config.hover_height), STRAIGHT)
        yield from self.skills.reach(start, facing, tolerance=self.config.approach_tolerance)
        lowest = start[2] - self.config.hover_height - self.config.lowering
        yield from self.skills.lower_until_contact(facing, lowest=lowest)

    def _aside(self, load: np.ndarray) -> np.ndarray:
        config, lead = self.config, self.fit.lead_at(self._rim - self._place(self._end)[2])
        if lead is None or load[2] < config.sure_force:
            return np.zeros(2)
        moment = self.skills.load_moment(self._place(self._end + np.array([*lead.middle, 0.0])))
        contact = lead.tells * np.array([-moment[1], moment[0]]) / load[2]
        distance = np.linalg.norm(contact)
        if distance < config.centred:
            return np.zeros(2)
        return (config.slide if lead.is_pin_below else -config.slide) * contact / distance


class UprightGearExpert(UprightInsertionExpert):
    """Lowers the bore over the shaft, and turns the gear to and fro until its teeth fall into gaps.

    Where teeth stand on teeth, it presses less now and then, so that the gear turns over its neighbours instead of with them.
    """

    config = UprightConfig(twist=0.10, press_force=6.0)  # tuned

    def _press_force(self, stuck: int) -> float:
        unloaded = stuck // self.config.unload_every % 2 == 1
        return self.config.light_press if unloaded else self.config.press_force


@register_demonstrator("ManiFeel-PegInsertion-v1", "ManiFeel-USBInsertion-v1", "ManiFeel-PowerPlugInsertion-v1")
def insertion_expert(env: InsertionEnv, seed: int) -> InsertionExpert:
    """The demonstrator for the sizes of the parts: upright where they have play, leaning where they have not."""
    return (UprightInsertionExpert if env.fit.goes_in_upright else LeaningInsertionExpert)(env, seed)


@register_demonstrator("ManiFeel-GearAssembly-v1")
def gear_expert(env: InsertionEnv, seed: int) -> InsertionExpert:
    """The demonstrator of the gear for the sizes of the parts."""
    return (UprightGearExpert if env.fit.goes_in_upright else LeaningGearExpert)(env, seed)
