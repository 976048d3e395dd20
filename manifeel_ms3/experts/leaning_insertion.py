"""Demonstrator of a tight fit: approach, touch, feel for the hole with a tilted plug, align, press."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from manifeel_ms3.tasks.insertion.base import InsertionEnv

from .insertion import STRAIGHT, InsertionExpert, InsertionExpertConfig
from .skills import Actions, above


@dataclass(frozen=True)
class LeaningConfig(InsertionExpertConfig):
    """Constants of the demonstrator that leans the plug.

    Values without another origin were tuned by hand; docs/tasks.md has the success of every task over the seeds that it names.
    """

    feel_press: float = 2.0
    """As in `InsertionExpertConfig`, in N; smaller, since the leading corner is a small contact. Tuned."""
    press_force: float = 8.0
    """As in `InsertionExpertConfig`, in N. Tuned."""
    corner_aim: float = 0.75
    """Distance of the place where the leading corner is first set down from the hole's own corner, as a share of the hole's
    half size: near its middle, which allows for the error of sight. Tuned."""
    lead: float = 0.0007
    """Depth, in m, that the leading corner can reach before the plug's other side meets the hole's. Tuned."""
    leans: tuple[float, float] = (float(np.deg2rad(5.0)), float(np.deg2rad(12.0)))
    """Smallest and largest lean of the plug along x and along y, in rad. Tuned."""
    search_radius: float = 0.0012
    """Distance of the second and later landing places from the first, in m. Tuned."""
    search_places: int = 6
    """Number of landing places on the circle of `search_radius`. Tuned."""
    landing_height: float = 0.003
    """Height over the rim from which the leading corner is lowered, in m. Tuned."""
    landing_depth: float = 0.006
    """Largest distance by which the leading corner is lowered, in m. Tuned."""
    landed_in_hole: float = 0.0004
    """Depth of the leading corner below the rim, in m, beyond which it is in the hole. Tuned."""

    feel_force: float = 1.8
    """Force on the plug, in N, that counts as a wall if the plug no longer moves; friction alone can be as large. Tuned."""
    wall_force: float = 4.5
    """Force on the plug, in N, that counts as a wall in any case. Tuned."""
    feel_step: float = 6e-4
    """Motion towards the walls, in m per step. Tuned."""
    stalled: float = 2e-4
    """Motion in one step, in m, below which the plug no longer moves. Tuned."""
    feel_steps: int = 60
    """Number of steps after which the search for the walls ends. Tuned."""

    stand_up_steps: int = 30
    """Number of steps for each of the two rotations that stand the plug up. Tuned."""
    stand_up_push: tuple[float, float, float] = (3e-4, 3e-4, -3e-4)
    """Offset of the command into the hole's corner while the plug is stood up, in m. Tuned."""


class LeaningInsertionExpert(InsertionExpert):
    """Finds a hole with little play by touch.

    It leans the plug, so that one corner goes ahead into the hole, pushes it into the hole's own corner until both walls are
    felt, stands the plug up in it, and presses it down, as people do with a tight fit.
    """

    config = LeaningConfig()

    def __init__(self, env: InsertionEnv, seed: int):
        super().__init__(env, seed)
        corner, self._aim, lean = self._leading_corner()
        self._corner = np.array([corner[0], -corner[1], env.fit.reach])  # plug frame: z ahead, y turned over
        down_x, down_y = np.sign(corner) * lean
        self._lean = Rotation.from_euler("xy", [-down_y, down_x])
        self._lean_on_edge = Rotation.from_euler("x", -down_y)

    def _leading_corner(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The corner that goes ahead, where it is set down, and the plug's lean.

        Returns:
            Corner of the foremost face when the plug is in, (x, y) in m from the socket's axis.
            Place where it is set down, well within the hole, in the same form.
            Lean along x and along y, in rad.
        """
        config, hole, hole_at = self.config, np.array(self.fit.hole), np.array(self.fit.hole_at)
        lean = np.clip(np.arctan(config.lead / ((2 - config.corner_aim) * hole)), *config.leans)
        return hole_at + self.fit.pin, hole_at + (1 - config.corner_aim) * hole, lean

    def _enter(self) -> Actions:
        over = np.array([*(self.socket[:2] + self._aim), self._rim])
        start = self._tool_for(self._corner, above(over, self.config.hover_height), self._lean)
        yield from self.skills.reach(*start, tolerance=self.config.approach_tolerance)
        yield from self._touch_down(over, self._lean)
        yield from self._feel_corner(self._lean)
        yield from self._stand_up()

    def _touch_down(self, over: np.ndarray, lean: Rotation) -> Actions:
        """Lower the leading corner; where it lands on the rim instead of in the hole, try the next place of a circle."""
        skills, config = self.skills, self.config
        angles = np.arange(config.search_places) * np.pi / (config.search_places / 2)
        circle = [(config.search_radius, angle) for angle in angles]
        for radius, angle in [(0.0, 0.0), *circle]:
            shift = radius * np.array([np.cos(angle), np.sin(angle), 0.0])
            start, facing = self._tool_for(self._corner, above(over + shift, config.landing_height), lean)
            yield from skills.reach(start, facing, tolerance=config.approach_tolerance)
            yield from skills.lower_until_contact(facing, lowest=start[2] - config.landing_depth)
            if self._place(self._corner)[2] < self._rim - config.landed_in_hole:
                return

    def _feel_corner(self, lean: Rotation) -> Actions:
        """Push the leading corner towards +x and +y, lightly pressed down, until both walls push back."""
        skills, config = self.skills, self.config
        last = self._place(self._corner)
        for _ in range(config.feel_steps):
            command, _ = skills.commanded
            load, place = skills.load, self._place(self._corner)
            stalled = (place - last < config.stalled)[:2]
            felt = (load[:2] < -config.wall_force) | ((load[:2] < -config.feel_force) & stalled)
            if felt.all():
                return
            last = place
            down = np.clip(config.compliance * (load[2] - config.feel_press), -config.feel_step, config.feel_step)
            move = np.array([*np.where(felt, 0.0, config.feel_step), down])
            yield skills.command(command + move, self._facing(lean))

    def _stand_up(self) -> Actions:
        """Turn the plug upright about its leading corner, which stays lightly pushed down into the hole's corner.

        It turns first until the long edge lies in the hole, then all the way.
        """
        skills, config = self.skills, self.config
        place = self._place(self._corner)
        for upright in (self._lean_on_edge, STRAIGHT):
            for _ in range(config.stand_up_steps):
                if self._tilt(upright) < config.upright:
                    break
                facing = skills.towards(self._facing(upright), config.turn_rate)
                position, rotation = self._plug_in_tool()
                target = place - facing.apply(position + rotation.apply(self._corner))
                yield skills.command(target + np.array(config.stand_up_push), facing)


class LeaningPowerPlugExpert(LeaningInsertionExpert):
    """Presses less now and then, so that blades that stand on the rim slide into their holes while the plug is wriggled."""

    config = LeaningConfig(light_press=1.0)  # tuned


@dataclass(frozen=True)
class LeaningGearConfig(LeaningConfig):
    """Constants of the demonstrator that leans a gear."""

    twist: float = 0.10
    """As in `InsertionExpertConfig`. Tuned."""
    beside: float = 0.0022
    """Distance from the shaft's side to where the bore's rim is set down, in m. Tuned."""
    lean: tuple[float, float] = (float(np.deg2rad(7.0)), float(np.deg2rad(5.0)))
    """Lean of the gear along x and along y, in rad. Tuned."""


class LeaningGearExpert(LeaningInsertionExpert):
    """Puts a gear's bore over its shaft like a plug into a socket, feeling for the shaft's side with the bore's rim."""

    config = LeaningGearConfig()

    def _leading_corner(self):
        diagonal, config = -np.sqrt(0.5), self.config
        corner, aim = diagonal * np.array(self.fit.hole), diagonal * (np.array(self.fit.pin) + config.beside)
        return corner, aim, np.array(config.lean)
