"""Demonstrator for ManiFeel-PegInsertion-v1: approach, touch, feel for the hole with a tilted peg, align, press."""

import numpy as np
from scipy.spatial.transform import Rotation

from manifeel_ms3.geometry.pegs import PEG_SIZE, SOCKET_DEPTH
from manifeel_ms3.tasks.peg_insertion import PegInsertionEnv

from .skills import Actions, Skills

SIGHT_ERROR = 0.0015  # m: how far off the eye places the hole, about two pixels of the wrist camera
GRASP_ERROR = np.deg2rad(0.5)  # how well TacRGB shows the peg's pitch in the hand
HOVER = 0.010  # m above the socket
LEAN = np.deg2rad([5.0, 7.0])  # of the peg while it feels for the hole, about x and y: its lowest corner is (+x, +y)
CORNER_AIM = (0.0045, 0.0033)  # m inside the hole's (+x, +y) corner: near its middle, for what the eye may be off
FEEL_FORCE = 2.5  # N: a wall is felt
UPRIGHT = np.deg2rad(0.7)
STAND_UP_TURN = 0.012  # rad a step
STAND_UP_STEPS = 25
STAND_UP_PUSH = np.array([4e-4, 4e-4, -5e-4])  # m that the command leads into the hole's corner meanwhile
ENTERED = 0.0008  # m below the rim, of the peg's end: it is in the hole
ASTRAY = 0.004  # m from where the hole was seen: the peg slides about on top
PATIENCE = 15  # steps without getting deeper, before starting over
PRESS = 0.003  # m that the command leads into a contact: about 8 N
PRESS_FORCE = 10.0  # N: enough
GIVE = 1.5e-4  # m/N: how far the hand gives way to a sideways push
WRIGGLE = 4e-4  # m
DOWN = np.array([0.0, 0.0, -1.0])
STRAIGHT = Rotation.identity()
DOWNWARD = Rotation.from_euler("x", np.pi)  # of the tool, and of the peg in it: frames with their z down
END = np.array([0.0, 0.0, -PEG_SIZE[2] / 2])  # of the peg
CORNER = np.array(PEG_SIZE) / 2 * [1, 1, -1]  # of the peg, that goes ahead


class PegInsertionExpert:
    """Knows the parts, sees roughly where the socket is, and finds the hole by touch.

    It leans the peg, so that one corner goes ahead into the hole, pushes it into the hole's own corner until both walls are
    felt, stands the peg up in it, and presses it down: what people do with a tight fit.
    """

    def __init__(self, env: PegInsertionEnv, seed: int):
        rng = np.random.default_rng([seed, 7])
        self.env = env
        self.skills = Skills(env)
        angle, radius = rng.uniform(0, 2 * np.pi), SIGHT_ERROR * np.sqrt(rng.uniform())
        socket = env.socket.pose.raw_pose[0, :3].cpu().numpy().astype(np.float64)
        self.hole = socket + radius * np.array([np.cos(angle), np.sin(angle), 0.0])  # floor's centre, as seen
        self._misjudged = Rotation.from_euler("y", rng.uniform(-1, 1) * GRASP_ERROR)
        self.hole_half = np.array(env.hole_size) / 2

    # ---------------------------------------------------------------- the peg in the hand

    def _peg_in_tool(self) -> tuple[np.ndarray, Rotation]:
        """The peg as the tactile images show it, pitch a little off."""
        pose = (self.env.agent.tcp.pose.inv() * self.env.peg.pose).raw_pose[0].cpu().numpy().astype(np.float64)
        return pose[:3], self._misjudged * Rotation.from_quat(pose[[4, 5, 6, 3]])

    def _tool_for(self, point_on_peg: np.ndarray, place: np.ndarray, lean: Rotation) -> tuple[np.ndarray, Rotation]:
        """Tool pose that puts a point of the peg (its frame, end down) at a place, the peg leaning by `lean`."""
        position, rotation = self._peg_in_tool()
        facing = lean * DOWNWARD * rotation.inv()
        return place - facing.apply(position + rotation.apply(DOWNWARD.apply(point_on_peg))), facing

    # ---------------------------------------------------------------- the demonstration

    def actions(self) -> Actions:
        """Actions of one episode, from its start until the peg sits; endless, as it goes on holding it down."""
        skills = self.skills
        yield np.zeros(6)
        skills.tare()
        lean = Rotation.from_euler("xy", [-LEAN[0], LEAN[1]])
        rim = np.array([0.0, 0.0, SOCKET_DEPTH])
        inner = np.array([*(self.hole_half - CORNER_AIM), 0.0])
        over = self.hole + rim + inner
        while True:
            yield from skills.reach(*self._tool_for(CORNER, over + [0, 0, HOVER], lean), tolerance=1e-3)
            yield from self._touch_down(over, lean)
            yield from self._feel_corner(lean)
            yield from self._stand_up(lean)
            yield from self._press()
            here, facing = skills.commanded
            yield from skills.reach(here + [0, 0, HOVER], facing, tolerance=2e-3)

    def _place(self, point_on_peg: np.ndarray) -> np.ndarray:
        """Where a point of the peg is, going by the hand's pose and the tactile images."""
        position, rotation = self._peg_in_tool()
        tool, facing = self.skills.tool
        return tool + facing.apply(position + rotation.apply(DOWNWARD.apply(point_on_peg)))

    def _touch_down(self, over: np.ndarray, lean: Rotation) -> Actions:
        """Lower the leading corner; where it lands on the rim instead of in the hole, try the next place of a spiral."""
        skills = self.skills
        for ring, angle in [(0.0, 0.0), *((0.0012, a) for a in np.arange(6) * np.pi / 3)]:
            shift = ring * np.array([np.cos(angle), np.sin(angle), 0.0])
            start, facing = self._tool_for(CORNER, over + shift + [0, 0, 0.003], lean)
            yield from skills.reach(start, facing, tolerance=1e-3)
            yield from skills.lower_until_contact(facing, lowest=start[2] - 0.006)
            if self._place(CORNER)[2] < SOCKET_DEPTH - 0.0004:
                return

    def _feel_corner(self, lean: Rotation) -> Actions:
        """Push the leading corner towards +x and +y, lightly pressed down, until both walls push back."""
        skills = self.skills
        for _ in range(60):
            here, _ = skills.commanded
            _, facing = skills.tool
            load = skills.load
            if load[0] < -FEEL_FORCE and load[1] < -FEEL_FORCE:
                return
            step = np.array(
                [
                    0.0006 if load[0] > -FEEL_FORCE else 0.0,
                    0.0006 if load[1] > -FEEL_FORCE else 0.0,
                    -0.0006 if load[2] < 3.0 else (0.0006 if load[2] > 6.0 else 0.0),
                ]
            )
            yield skills.command(here + step, self._facing(lean))

    def _facing(self, lean: Rotation) -> Rotation:
        return self._tool_for(np.zeros(3), np.zeros(3), lean)[1]

    def _stand_up(self, lean: Rotation) -> Actions:
        """Turn the peg upright about its leading corner, which stays lightly pushed into the hole's corner and down: first
        until the long edge lies in the hole, then all the way."""
        skills = self.skills
        place = self._place(CORNER)
        for upright in (Rotation.from_euler("x", -LEAN[0]), STRAIGHT):
            for _ in range(STAND_UP_STEPS):
                if self._tilt(upright) < UPRIGHT:
                    break
                facing = skills.towards(self._facing(upright), STAND_UP_TURN)
                position, rotation = self._peg_in_tool()
                target = place - facing.apply(position + rotation.apply(DOWNWARD.apply(CORNER)))
                yield skills.command(target + STAND_UP_PUSH, facing)

    def _tilt(self, upright: Rotation = STRAIGHT) -> float:
        """Angle of the peg from a facing, rad, going by the hand's pose and the tactile images."""
        _, facing = self.skills.tool
        return (self._facing(upright) * facing.inv()).magnitude()

    def _press(self) -> Actions:
        """Press down, giving way to what pushes sideways and to what tilts; where it sticks, ease off and wriggle. Ends only
        when the peg has not even entered."""
        skills = self.skills
        stuck, best = 0, np.inf
        for step in range(10_000):
            here, _ = skills.tool
            load = skills.load
            stuck = 0 if here[2] < best - 1e-4 else stuck + 1
            best = min(best, here[2])
            end = self._place(END)
            strayed = np.linalg.norm((end - self.hole)[:2]) > ASTRAY
            if strayed or (stuck > PATIENCE and end[2] > SOCKET_DEPTH - ENTERED):
                return
            aside = np.clip(GIVE * load * [1, 1, 0], -0.001, 0.001)
            push = PRESS if load[2] < PRESS_FORCE and self._tilt() < 3 * UPRIGHT else 0.0
            if stuck > 4:
                aside[:2] += WRIGGLE * np.array([np.cos(1.3 * step), np.sin(1.3 * step)])
            facing = skills.towards(self._facing(STRAIGHT), STAND_UP_TURN)
            yield skills.command(here + push * DOWN + aside, facing)
