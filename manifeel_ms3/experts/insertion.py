"""Demonstrator of the insertion tasks: approach, touch, feel for the hole with a tilted plug, align, press."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from manifeel_ms3.tasks.insertion.base import InsertionEnv
from manifeel_ms3.tasks.registry import register_demonstrator

from .skills import DOWNWARD, Actions, Skills, above, perceived_position, position_rotation

STRAIGHT = Rotation.identity()


@dataclass(frozen=True)
class InsertionExpertConfig:
    """Constants of the demonstrator of the insertion tasks.

    Values without another origin were tuned by hand; docs/tasks.md has the success of every task over seeds 0 to 99.
    """

    grasp_error: float = float(np.deg2rad(0.5))
    """Largest error of the plug's pitch in the hand, in rad: how well TacRGB shows it."""
    hover_height: float = 0.010
    """Height over the rim from which the plug approaches and to which it returns, in m. Tuned."""
    approach_tolerance: float = 1e-3
    """Distance from a target in free space at which the hand has arrived, in m. Tuned."""
    return_tolerance: float = 2e-3
    """The same for the way back before a new attempt, in m. Tuned."""

    search_radius: float = 0.0012
    """Distance of the second and later landing places from the first, in m. Tuned."""
    search_places: int = 6
    """Number of landing places on the circle of that radius. Tuned."""
    landing_height: float = 0.003
    """Height over the rim from which the leading corner is lowered, in m. Tuned."""
    landing_depth: float = 0.006
    """Largest distance by which it is lowered, in m. Tuned."""
    landed_in_hole: float = 0.0004
    """Depth of the leading corner below the rim, in m, beyond which it is in the hole. Tuned."""

    feel_force: float = 2.5
    """Force on the plug, in N, that is a wall if the plug no longer moves: friction pushes back, too. Tuned."""
    wall_force: float = 7.0
    """Force on the plug, in N, that is a wall in any case. Tuned."""
    feel_step: float = 6e-4
    """Step towards the walls, in m per step. Tuned."""
    stalled: float = 2e-4
    """Motion in one step, in m, below which the plug no longer moves. Tuned."""
    feel_steps: int = 60
    """Number of steps after which the search for the walls ends. Tuned."""
    feel_press: float = 4.5
    """Downward force while the plug is pushed to the walls or leans, in N. Tuned."""

    upright: float = float(np.deg2rad(0.7))
    """Angle, in rad, below which the plug counts as upright. Tuned."""
    leaning: float = 3.0
    """Multiple of `upright` beyond which the plug is pressed with `feel_press` only. Tuned."""
    stand_up_turn: float = 0.012
    """Rotation while the plug is stood up, in rad per step. Tuned."""
    stand_up_steps: int = 30
    """Number of steps for each of the two rotations that stand the plug up. Tuned."""
    stand_up_push: tuple[float, float, float] = (4e-4, 4e-4, -5e-4)
    """Offset of the command into the hole's corner while the plug is stood up, in m. Tuned."""

    press_force: float = 10.0
    """Downward force that presses the plug in, in N. Tuned."""
    compliance: float = 1.5e-4
    """Motion of the hand per step and per newton of unwanted force, in m/N. Tuned."""
    force_step: float = 0.0012
    """Largest step under force, along each axis, in m. Tuned."""
    press_steps: int = 10_000
    """Number of steps after which pressing ends: more than any episode has."""
    progress: float = 1e-4
    """Descent, in m, that counts as progress. Tuned."""
    patience: int = 15
    """Number of steps without progress after which a plug outside the hole starts over. Tuned."""
    entered: float = 0.0008
    """Depth of the plug's end below the rim, in m, beyond which it is in the hole. Tuned."""
    astray: float = 0.004
    """Distance of the plug's end from the perceived socket, in m, beyond which it slides about on top. Tuned."""

    wriggle_after: int = 4
    """Number of steps without progress after which the plug is wriggled. Tuned."""
    wriggle: float = 4e-4
    """Radius of the wriggling circle, in m. Tuned."""
    wriggle_rate: float = 1.3
    """Angle on the wriggling circle, in rad per step. Tuned."""
    twist: float = 0.0
    """Amplitude, in rad, of the rotation to and fro of a plug that sticks, until its teeth fall into gaps."""
    twist_rate: float = 0.15
    """Phase of that rotation, in rad per step. Tuned."""
    twist_growth: float = 50.0
    """Number of steps without progress after which the amplitude has doubled, its limit. Tuned."""


@register_demonstrator("ManiFeel-PegInsertion-v1", "ManiFeel-USBInsertion-v1", "ManiFeel-PowerPlugInsertion-v1")
class InsertionExpert:
    """Knows the parts, sees roughly where the socket is, and finds the hole by touch.

    It leans the plug, so that one corner goes ahead into the hole, pushes it into the hole's own corner until both walls are
    felt, stands the plug up in it, and presses it down: what people do with a tight fit.

    Two things are read from the simulator instead of from images: the socket's position, with an error of up to
    `SkillConfig.sight_error`, and the plug's pose in the hand, with an error of its pitch of up to `grasp_error`.
    """

    config = InsertionExpertConfig()

    def __init__(self, env: InsertionEnv, seed: int):
        self._rng = np.random.default_rng([seed, 7])
        self.env, self.fit = env, env.fit
        self.skills = Skills(env)
        self._pitch_error = Rotation.from_euler("y", self._rng.uniform(-1, 1) * self.config.grasp_error)
        self._see_socket()
        fit = env.fit
        self._corner = np.array([fit.corner[0], -fit.corner[1], fit.reach])  # plug frame: z ahead, y turned over
        self._end = np.array([0.0, 0.0, fit.reach])
        self._rim = self.socket[2] + fit.rim
        down_x, down_y = np.sign(fit.corner) * fit.lean
        self._lean = Rotation.from_euler("xy", [-down_y, down_x])
        self._lean_on_edge = Rotation.from_euler("x", -down_y)

    def _see_socket(self) -> None:
        """Perceive the socket's position, with a new error."""
        self.socket = perceived_position(self.env.socket, self._rng)

    # ---------------------------------------------------------------- the plug in the hand

    def _plug_in_tool(self) -> tuple[np.ndarray, Rotation]:
        """Pose of the plug in the tool's frame: the simulator's pose with a constant error of its pitch.

        It stands for an estimate from the tactile images, which the demonstrator does not make.
        """
        position, rotation = position_rotation((self.env.agent.tcp.pose.inv() * self.env.plug.pose).raw_pose)
        return position, self._pitch_error * rotation

    def _tool_for(self, point: np.ndarray, place: np.ndarray, lean: Rotation) -> tuple[np.ndarray, Rotation]:
        """Tool pose that puts a point of the plug (its frame) at a place, the plug leaning by `lean` from straight down."""
        position, rotation = self._plug_in_tool()
        facing = lean * DOWNWARD * rotation.inv()
        return place - facing.apply(position + rotation.apply(point)), facing

    def _place(self, point: np.ndarray) -> np.ndarray:
        """Position, in the base frame, of a point of the plug, by the tool's pose and the estimated pose in the hand."""
        position, rotation = self._plug_in_tool()
        tool, facing = self.skills.tool
        return tool + facing.apply(position + rotation.apply(point))

    def _facing(self, lean: Rotation) -> Rotation:
        return self._tool_for(np.zeros(3), np.zeros(3), lean)[1]

    def _tilt(self, upright: Rotation = STRAIGHT) -> float:
        """Angle, in rad, of the plug from an orientation, by the tool's pose and the estimated pose in the hand."""
        _, facing = self.skills.tool
        return (self._facing(upright) * facing.inv()).magnitude()

    # ---------------------------------------------------------------- the demonstration

    def actions(self) -> Actions:
        """Actions of one episode, without end: once the plug sits, the demonstrator goes on holding it down."""
        skills, config = self.skills, self.config
        yield np.zeros(6)
        skills.tare()
        while True:
            yield from self._enter()
            yield from self._press()
            here, facing = skills.commanded
            yield from skills.reach(above(here, config.hover_height), facing, tolerance=config.return_tolerance)
            self._see_socket()

    def _enter(self) -> Actions:
        """Bring the plug's end into the hole, or onto its rim."""
        over = np.array([*(self.socket[:2] + self.fit.aim), self._rim])
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
                facing = skills.towards(self._facing(upright), config.stand_up_turn)
                position, rotation = self._plug_in_tool()
                target = place - facing.apply(position + rotation.apply(self._corner))
                yield skills.command(target + np.array(config.stand_up_push), facing)

    def _press(self) -> Actions:
        """Press down and comply with sideways forces and tilts; where the plug sticks, wriggle.

        It ends only when the plug has not entered the hole, or slides about on top.
        """
        skills, config = self.skills, self.config
        stuck, best = 0, np.inf
        for step in range(config.press_steps):
            here, _ = skills.tool
            load = skills.load
            stuck = 0 if here[2] < best - config.progress else stuck + 1
            best = min(best, here[2])
            if self._is_outside(stuck):
                return
            leaning = self._tilt() > config.leaning * config.upright
            wanted = [0, 0, config.feel_press if leaning else config.press_force]
            move = np.clip(config.compliance * (load - wanted), -config.force_step, config.force_step)
            if stuck > config.wriggle_after:
                angle = config.wriggle_rate * step
                move[:2] += config.wriggle * np.array([np.cos(angle), np.sin(angle)])
            command, _ = skills.commanded
            facing = self._twisted(stuck) * self._facing(STRAIGHT)
            yield skills.command(command + move, skills.towards(facing, config.stand_up_turn))

    def _is_outside(self, stuck: int) -> bool:
        """Whether the plug's end has slid away from the socket, or has been on the rim for too long."""
        end = self._place(self._end)
        astray = np.linalg.norm((end - self.socket)[:2]) > self.config.astray
        return bool(astray or (stuck > self.config.patience and end[2] > self._rim - self.config.entered))

    def _twisted(self, stuck: int) -> Rotation:
        """Rotation about the vertical of a plug that has been stuck for so many steps."""
        swing = self.config.twist * min(1 + stuck / self.config.twist_growth, 2.0)
        return Rotation.from_euler("z", swing * np.sin(self.config.twist_rate * stuck))


@register_demonstrator("ManiFeel-GearAssembly-v1")
class GearExpert(InsertionExpert):
    """Puts the bore over the shaft like a plug into a socket, with its rim against the shaft's side."""

    config = InsertionExpertConfig(twist=0.10)  # tuned
