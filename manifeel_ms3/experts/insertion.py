"""Demonstrator of the insertion tasks: approach, touch, feel for the hole with a tilted plug, align, press."""

import numpy as np
from scipy.spatial.transform import Rotation

from manifeel_ms3.tasks.insertion.base import InsertionEnv
from manifeel_ms3.tasks.registry import register_demonstrator

from .skills import DOWNWARD, Actions, Skills, seen

GRASP_ERROR = np.deg2rad(0.5)  # how well TacRGB shows the plug's pitch in the hand
HOVER = 0.010  # m above the socket
FEEL_FORCE, WALL_FORCE = 2.5, 7.0  # N: a wall is felt if it goes no further; a wall is felt
FEEL_STEP, STALL = 6e-4, 2e-4  # m a step; less than this is no further
UPRIGHT = np.deg2rad(0.7)
STAND_UP_TURN = 0.012  # rad a step
STAND_UP_STEPS = 30
STAND_UP_PUSH = np.array([4e-4, 4e-4, -5e-4])  # m that the command leads into the hole's corner meanwhile
ENTERED = 0.0008  # m below the rim, of the plug's end: it is in the hole
ASTRAY = 0.004  # m from where the hole was seen: the plug slides about on top
PATIENCE = 15  # steps without getting deeper, before starting over
PRESS_FORCE = 10.0  # N
FEEL_PRESS = 4.5  # N, downwards, while it feels for the walls
YIELD = 1.5e-4  # m/N a step: how the hand goes after a force that it does not want
STEP = 0.0012  # m, at most, of a step under force
WRIGGLE = 4e-4  # m
TWIST_RATE = 0.15  # rad a step, of a sine
TWIST_GROWS = 50  # steps in which it swings as far again
STRAIGHT = Rotation.identity()


@register_demonstrator(
    "ManiFeel-PegInsertion-v1", "ManiFeel-USBInsertion-v1", "ManiFeel-PowerPlugInsertion-v1", "ManiFeel-PegReorientation-v1"
)
class InsertionExpert:
    """Knows the parts, sees roughly where the socket is, and finds the hole by touch.

    It leans the plug, so that one corner goes ahead into the hole, pushes it into the hole's own corner until both walls are
    felt, stands the plug up in it, and presses it down: what people do with a tight fit.
    """

    twist = 0.0
    """rad that it turns the plug to and fro by where it sticks, until its teeth fall into gaps"""

    def __init__(self, env: InsertionEnv, seed: int):
        self._rng = np.random.default_rng([seed, 7])
        self.env, self.fit = env, env.fit
        self.skills = Skills(env)
        self._misjudged = Rotation.from_euler("y", self._rng.uniform(-1, 1) * GRASP_ERROR)
        self._look()
        fit = env.fit
        self._corner = np.array([fit.corner[0], -fit.corner[1], fit.reach])  # plug frame: z ahead, y turned over
        self._end = np.array([0.0, 0.0, fit.reach])
        self._rim = self.socket[2] + fit.rim
        down_x, down_y = np.sign(fit.corner) * fit.lean
        self._lean = Rotation.from_euler("xy", [-down_y, down_x])
        self._lean_on_edge = Rotation.from_euler("x", -down_y)

    def _look(self) -> None:
        """See where the socket is, a little off."""
        self.socket = seen(self.env.socket, self._rng)

    # ---------------------------------------------------------------- the plug in the hand

    def _plug_in_tool(self) -> tuple[np.ndarray, Rotation]:
        """The plug as the tactile images show it, pitch a little off."""
        pose = (self.env.agent.tcp.pose.inv() * self.env.plug.pose).raw_pose[0].cpu().numpy().astype(np.float64)
        return pose[:3], self._misjudged * Rotation.from_quat(pose[[4, 5, 6, 3]])

    def _tool_for(self, point: np.ndarray, place: np.ndarray, lean: Rotation) -> tuple[np.ndarray, Rotation]:
        """Tool pose that puts a point of the plug (its frame) at a place, the plug leaning by `lean` from straight down."""
        position, rotation = self._plug_in_tool()
        facing = lean * DOWNWARD * rotation.inv()
        return place - facing.apply(position + rotation.apply(point)), facing

    def _place(self, point: np.ndarray) -> np.ndarray:
        """Where a point of the plug is, going by the hand's pose and the tactile images."""
        position, rotation = self._plug_in_tool()
        tool, facing = self.skills.tool
        return tool + facing.apply(position + rotation.apply(point))

    # ---------------------------------------------------------------- the demonstration

    def actions(self) -> Actions:
        """Actions of one episode, from its start until the plug sits; endless, as it goes on holding it down."""
        skills = self.skills
        yield np.zeros(6)
        skills.tare()
        lean = self._lean
        while True:
            over = np.array([*(self.socket[:2] + self.fit.aim), self._rim])
            yield from skills.reach(*self._tool_for(self._corner, over + [0, 0, HOVER], lean), tolerance=1e-3)
            yield from self._touch_down(over, lean)
            yield from self._feel_corner(lean)
            yield from self._stand_up()
            yield from self._press()
            here, facing = skills.commanded
            yield from skills.reach(here + [0, 0, HOVER], facing, tolerance=2e-3)
            self._look()

    def _touch_down(self, over: np.ndarray, lean: Rotation) -> Actions:
        """Lower the leading corner; where it lands on the rim instead of in the hole, try the next place of a spiral."""
        skills = self.skills
        for ring, angle in [(0.0, 0.0), *((0.0012, a) for a in np.arange(6) * np.pi / 3)]:
            shift = ring * np.array([np.cos(angle), np.sin(angle), 0.0])
            start, facing = self._tool_for(self._corner, over + shift + [0, 0, 0.003], lean)
            yield from skills.reach(start, facing, tolerance=1e-3)
            yield from skills.lower_until_contact(facing, lowest=start[2] - 0.006)
            if self._place(self._corner)[2] < self._rim - 0.0004:
                return

    def _feel_corner(self, lean: Rotation) -> Actions:
        """Push the leading corner towards +x and +y, lightly pressed down, until both walls push back."""
        skills = self.skills
        last = self._place(self._corner)
        for _ in range(60):
            command, _ = skills.commanded
            load, place = skills.load, self._place(self._corner)
            # friction pushes back, too: a wall is where it goes no further
            felt = (load[:2] < -WALL_FORCE) | ((load[:2] < -FEEL_FORCE) & (place - last < STALL)[:2])
            if felt.all():
                return
            last = place
            down = np.clip(YIELD * (load[2] - FEEL_PRESS), -FEEL_STEP, FEEL_STEP)
            yield skills.command(command + [*np.where(felt, 0.0, FEEL_STEP), down], self._facing(lean))

    def _facing(self, lean: Rotation) -> Rotation:
        return self._tool_for(np.zeros(3), np.zeros(3), lean)[1]

    def _stand_up(self) -> Actions:
        """Turn the plug upright about its leading corner, which stays lightly pushed into the hole's corner and down: first
        until the long edge lies in the hole, then all the way."""
        skills = self.skills
        place = self._place(self._corner)
        for upright in (self._lean_on_edge, STRAIGHT):
            for _ in range(STAND_UP_STEPS):
                if self._tilt(upright) < UPRIGHT:
                    break
                facing = skills.towards(self._facing(upright), STAND_UP_TURN)
                position, rotation = self._plug_in_tool()
                target = place - facing.apply(position + rotation.apply(self._corner))
                yield skills.command(target + STAND_UP_PUSH, facing)

    def _tilt(self, upright: Rotation = STRAIGHT) -> float:
        """Angle of the plug from a facing, rad, going by the hand's pose and the tactile images."""
        _, facing = self.skills.tool
        return (self._facing(upright) * facing.inv()).magnitude()

    def _press(self) -> Actions:
        """Press down, giving way to what pushes sideways and to what tilts; where it sticks, ease off and wriggle. Ends only
        when the plug has not even entered."""
        skills = self.skills
        stuck, best = 0, np.inf
        for step in range(10_000):
            here, _ = skills.tool
            load = skills.load
            stuck = 0 if here[2] < best - 1e-4 else stuck + 1
            best = min(best, here[2])
            end = self._place(self._end)
            strayed = np.linalg.norm((end - self.socket)[:2]) > ASTRAY
            if strayed or (stuck > PATIENCE and end[2] > self._rim - ENTERED):
                return
            leaning = self._tilt() > 3 * UPRIGHT
            move = np.clip(YIELD * (load - [0, 0, FEEL_PRESS if leaning else PRESS_FORCE]), -STEP, STEP)
            if stuck > 4:
                move[:2] += WRIGGLE * np.array([np.cos(1.3 * step), np.sin(1.3 * step)])
            swing = self.twist * min(1 + stuck / TWIST_GROWS, 2.0)
            twist = Rotation.from_euler("z", swing * np.sin(TWIST_RATE * stuck))
            command, _ = skills.commanded
            yield skills.command(command + move, skills.towards(twist * self._facing(STRAIGHT), STAND_UP_TURN))


@register_demonstrator("ManiFeel-GearAssembly-v1")
class GearExpert(InsertionExpert):
    """Puts the bore over the shaft like a plug into a socket, its rim hooked on the shaft's side."""

    twist = 0.10
