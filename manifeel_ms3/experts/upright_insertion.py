"""Demonstrator of a fit with play: bring the plug over the hole upright, lower it, slide as the contact shows, press."""

from dataclasses import dataclass

import numpy as np

from manifeel_ms3.geometry.fits import MeetingFaces
from manifeel_ms3.tasks.insertion.base import InsertionEnv
from manifeel_ms3.tasks.registry import register_demonstrator

from .insertion import STRAIGHT, InsertionExpert, InsertionExpertConfig
from .leaning_insertion import LeaningGearExpert, LeaningInsertionExpert, LeaningPowerPlugExpert
from .skills import Actions, above, aside


@dataclass(frozen=True)
class UprightConfig(InsertionExpertConfig):
    """Constants of the demonstrator that lowers the plug upright.

    Values without another origin were tuned by hand; docs/tasks.md has the success of every task over the seeds that it names.
    """

    keeps_hand: bool = True
    """As in `InsertionExpertConfig`: with play, the walls right a plug that has slipped in the hand."""
    hover_height: float = 0.015
    """Height over the rim, in m, from which the plug is lowered. Tuned."""
    aim_error: float = 0.006
    """Largest distance from the hole's axis, in m, of the point at `hover_height` to which the plug comes first. Tuned."""
    centring: float = 0.3
    """Share of its distance from the axis by which the plug is moved in one step while it is lowered. Tuned."""
    slope: float = 1.5
    """Smallest ratio of the plug's height over the rim to its distance from the axis: it is lowered within a cone. Tuned."""
    near: float = 0.001
    """Distance from the axis, in m, within which the plug is lowered all the way. Tuned."""
    lowering_speed: float = 0.002
    """Largest step of the plug downwards, in m. Tuned."""
    touch: float = 2.0
    """Upward force, in N, at which lowering ends. Tuned."""
    lowering: float = 0.003
    """Depth below the rim, in m, down to which the plug is lowered where nothing stops it. Tuned."""
    slide: float = 3e-4
    """Motion of the plug away from the edge that it stands on, in m per step. Tuned."""
    sure_force: float = 1.5
    """Downward force, in N, from which the place of a contact can be told. Tuned."""
    slipped: float = float(np.deg2rad(3.0))
    """Lean of a gear, in rad, from which on it has slipped in the hand and is set down anew. Tuned."""
    shallow: float = 0.012
    """Depth of the gear's end below the shaft's tip, in m, up to which a gear that slipped is set down anew. Tuned."""
    early: tuple[float, ...] = (0.002, 0.0005)
    """Depth before a pair of faces meets, in m, from which on a contact is taken for theirs, because the place of the
    plug's end is not known exactly; of the first pair and of the second. Tuned."""
    meeting_span: float = 0.003
    """Descent, in m, over which the contact of a pair of faces tells a direction; deeper, the pin is in the hole. Set once;
    not tuned."""
    centred: float = 0.0008
    """Distance of the contact from the middle, in m, below which it shows no direction. Tuned."""


class UprightInsertionExpert(InsertionExpert):
    """Does what a person does with half a millimetre of play.

    It comes roughly over the hole, brings the plug to its axis while it lowers it, and presses. Where the plug stands on an
    edge, the force comes from the side on which it overlaps, and it slides away from there. In the hole it yields to the walls.
    Almost every action depends only on what is seen and felt at that moment, so that a policy without memory can do the same;
    only where the plug has been stuck for several steps, that counts, too.
    """

    config = UprightConfig()

    def _enter(self) -> Actions:
        config, skills = self.config, self.skills
        hole = np.array([*self.socket[:2], self._rim])
        aim = above(hole, config.hover_height) + aside(self._rng, config.aim_error)
        start, facing = self._tool_for(self._end, aim, STRAIGHT)
        yield from skills.reach(start, facing, tolerance=config.approach_tolerance)
        while skills.load[2] <= config.touch:
            off = hole - self._place(self._end)
            if off[2] > config.lowering:
                return
            distance = np.linalg.norm(off[:2])
            is_aside = distance > max(config.near, -off[2] / config.slope)
            down = 0.0 if is_aside else config.lowering_speed
            command, _ = skills.commanded
            yield skills.command(command + np.array([*config.centring * off[:2], -down]), facing)

    def _aside(self, load: np.ndarray) -> np.ndarray:
        config, faces = self.config, self._meeting_faces()
        if faces is None or load[2] < config.sure_force:
            return np.zeros(2)
        moment = self.skills.load_moment(self._place(self._end + np.array([*faces.middle, 0.0])))
        contact = faces.tells * np.array([-moment[1], moment[0]]) / load[2]
        distance = np.linalg.norm(contact)
        if distance < config.centred:
            return np.zeros(2)
        return (config.slide if faces.is_pin_below else -config.slide) * contact / distance

    def _meeting_faces(self) -> MeetingFaces | None:
        """The pair of faces that meets at the plug's present depth; None if none does."""
        depth, found = self._rim - self._place(self._end)[2], None
        for faces, early in zip(self.fit.meeting_faces, self.config.early, strict=False):
            first = faces.depth - early
            if first <= depth < first + self.config.meeting_span:
                found = faces
        return found


class UprightGearExpert(UprightInsertionExpert):
    """Lowers a gear's bore over its shaft, and turns the gear to and fro until its teeth find gaps.

    Where teeth stand on teeth, it presses less now and then, so that the gear turns over its neighbours instead of with them.
    """

    config = UprightConfig(twist=0.10, press_force=6.0, light_press=1.0)  # tuned

    def _is_outside(self, stuck: int) -> bool:
        _, facing = self.skills.tool
        _, rotation = self._plug_in_tool()
        lean = np.arccos(np.clip(-(facing * rotation).apply([0.0, 0.0, 1.0])[2], -1.0, 1.0))
        shallow = self._place(self._end)[2] > self._rim - self.config.shallow
        return bool(lean > self.config.slipped and shallow) or super()._is_outside(stuck)


@register_demonstrator("ManiFeel-PegInsertion-v1", "ManiFeel-USBInsertion-v1")
def insertion_expert(env: InsertionEnv, seed: int) -> InsertionExpert:
    """Make the demonstrator that fits the sizes of the parts: upright where they have play, leaning where they have not."""
    return (UprightInsertionExpert if env.fit.goes_in_upright else LeaningInsertionExpert)(env, seed)


@register_demonstrator("ManiFeel-PowerPlugInsertion-v1")
def power_plug_expert(env: InsertionEnv, seed: int) -> InsertionExpert:
    """Make the demonstrator of the power plug that fits the sizes of the parts."""
    return (UprightInsertionExpert if env.fit.goes_in_upright else LeaningPowerPlugExpert)(env, seed)


@register_demonstrator("ManiFeel-GearAssembly-v1")
def gear_expert(env: InsertionEnv, seed: int) -> InsertionExpert:
    """Make the demonstrator of the gear that fits the sizes of the parts."""
    return (UprightGearExpert if env.fit.goes_in_upright else LeaningGearExpert)(env, seed)
