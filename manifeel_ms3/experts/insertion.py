"""What the demonstrators of the insertion tasks share: perceiving socket and plug, random pushes, and pressing the plug in."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from manifeel_ms3.tasks.insertion.base import InsertionEnv

from .skills import DOWNWARD, Actions, Skills, above, perceived_position, position_rotation

STRAIGHT = Rotation.identity()
"""Lean of an upright plug."""
STREAM = 7
"""Number beside the seed from which this demonstrator draws, so that its draws are not those of the task; arbitrary."""


@dataclass(frozen=True)
class InsertionExpertConfig:
    """Constants of the demonstrator of the insertion tasks.

    Values without another origin were tuned by hand; docs/tasks.md has the success of every task over the seeds that it names.
    """

    grasp_error: float = float(np.deg2rad(0.5))
    """Largest error of the plug's perceived pitch in the hand, in rad: about the accuracy of TacRGB."""
    hover_height: float = 0.010
    """Height over the rim from which the plug approaches and to which it returns, in m. Tuned."""
    approach_tolerance: float = 1e-3
    """Distance from a target in free space at which the hand has arrived, in m. Tuned."""
    return_tolerance: float = 2e-3
    """Distance from the point over the rim, in m, at which the hand has returned before a new attempt. Tuned."""

    feel_press: float = 4.5
    """Downward force while the plug leans, is led to a corner or slides on top of the socket, in N. Tuned."""
    upright: float = float(np.deg2rad(0.7))
    """Angle, in rad, below which the plug counts as upright. Tuned."""
    leaning: float = 3.0
    """Multiple of `upright` from which on the plug is pressed only with `feel_press`. Tuned."""
    turn_rate: float = 0.012
    """Rotation of the plug towards upright while it is in contact, in rad per step. Tuned."""

    disturbance_rate: float = 0.04
    """Chance, in each step, that a push of the hand begins while the plug is free: one or two in an episode."""
    disturbance: float = 0.3
    """Largest amount that a push adds to each axis of the action, as a share of the action's range. Chosen by eye."""
    disturbance_steps: int = 3
    """Number of steps that a push lasts. Chosen by eye."""
    free_height: float = 0.005
    """Height of the plug's end over the rim, in m, above which the hand is pushed. Chosen by eye."""

    press_force: float = 10.0
    """Downward force that presses the plug in, in N. Tuned."""
    light_press: float | None = None
    """Downward force, in N, that alternates with `press_force` on a plug that sticks, so that friction does not hold it there;
    None if the demonstrator never presses less. Tuned."""
    unload_every: int = 10
    """Number of steps between changes from `press_force` to `light_press` and back. Tuned."""
    compliance: float = 1.5e-4
    """Motion of the hand per step and per newton of unwanted force, in m/N. Tuned."""
    force_step: float = 0.0012
    """Largest step under force, along each axis, in m. Tuned."""
    press_steps: int = 10_000
    """Number of steps after which pressing ends: more than an episode has."""
    keeps_hand: bool = False
    """Whether the hand keeps its orientation while it presses, instead of following a plug that slips in it."""
    progress: float = 1e-4
    """Descent, in m, that counts as progress. Tuned."""
    patience: int = 15
    """Number of steps without progress after which a plug outside the hole starts over. Tuned."""
    entered: float = 0.0008
    """Depth of the plug's end below the rim, in m, beyond which it is in the hole. Tuned."""
    astray: float = 0.004
    """Distance of the plug's end from the perceived socket, in m, beyond which it has slid away. Tuned."""

    wriggle_after: int = 4
    """Number of steps without progress after which the plug is wriggled. Tuned."""
    wriggle: float = 4e-4
    """Radius of the wriggling circle, in m. Tuned."""
    wriggle_rate: float = 1.3
    """Angle on the wriggling circle, in rad per step. Tuned."""
    twist: float = 0.0
    """Amplitude, in rad, of the rotation to and fro of a plug that sticks, until its teeth find gaps; 0 if it has
    none."""
    twist_rate: float = 0.15
    """Phase of the rotation to and fro, in rad per step. Tuned."""
    twist_growth: float = 50.0
    """Number of steps without progress after which the amplitude `twist` has doubled, which is its limit. Tuned."""


class InsertionExpert:
    """Knows the parts' geometry and roughly the socket's position, and decides by the forces that the pads feel.

    Two things are read from the simulator instead of from images: the socket's position, with an error of up to
    `SkillConfig.sight_error`, and the plug's pose in the hand, with an error of its pitch of up to `grasp_error`.

    While the plug is free, the hand is pushed at random, so that the demonstrations show corrections.

    Args:
        env: Environment that has just been reset.
        seed: Seed of the episode.
    """

    config = InsertionExpertConfig()

    def __init__(self, env: InsertionEnv, seed: int):
        self._rng = np.random.default_rng([seed, STREAM])
        self.env, self.fit = env, env.fit
        self.skills = Skills(env)
        self._pitch_error = Rotation.from_euler("y", self._rng.uniform(-1, 1) * self.config.grasp_error)
        self._see_socket()
        self._end = np.array([0.0, 0.0, env.fit.reach])
        self._rim = self.socket[2] + env.fit.rim
        self._disturbance, self._disturbed_steps = np.zeros(6), 0
        self._kept: Rotation | None = None  # orientation that the hand keeps while it presses

    def _see_socket(self) -> None:
        """Perceive the socket's position, with a new error."""
        self.socket = perceived_position(self.env.socket, self._rng)

    # ---------------------------------------------------------------- the plug in the hand

    def _plug_in_tool(self) -> tuple[np.ndarray, Rotation]:
        """Pose of the plug in the tool's frame: the simulator's pose with a constant error of its pitch.

        It stands in for an estimate from the tactile images.
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
        """Orientation of the hand for a lean of the plug."""
        if self._kept is not None:
            return lean * self._kept
        return self._tool_for(np.zeros(3), np.zeros(3), lean)[1]

    def _tilt(self, upright: Rotation = STRAIGHT) -> float:
        """Angle, in rad, of the plug from an orientation, by the tool's pose and the estimated pose in the hand."""
        _, facing = self.skills.tool
        return (self._facing(upright) * facing.inv()).magnitude()

    # ---------------------------------------------------------------- the demonstration

    def actions(self) -> Actions:
        """Actions of an episode, without end: once the plug is inserted, the demonstrator keeps holding it down."""
        for action in self._undisturbed():
            push = self.skills.of_controlled_axes(self._disturb())
            action[: len(push)] += push
            yield np.clip(action, -1.0, 1.0)

    def _undisturbed(self) -> Actions:
        self.skills.keep_grip()
        yield self.skills.with_grip(self.skills.of_controlled_axes(np.zeros(6)))
        self.skills.tare()
        while True:
            yield from self._enter()
            self._kept = self._facing(STRAIGHT) if self.config.keeps_hand else None
            yield from self._press()
            self._kept = None
            here, facing = self.skills.commanded
            yield from self.skills.reach(above(here, self.config.hover_height), facing, tolerance=self.config.return_tolerance)
            self._see_socket()

    def _enter(self) -> Actions:
        """Bring the plug's end into the hole, or onto its rim."""
        raise NotImplementedError

    def _disturb(self) -> np.ndarray:
        """Disturbance (6,) that is added to the action: while the plug is free, an occasional push in a random direction."""
        config = self.config
        if self._disturbed_steps == 0:
            free = self._place(self._end)[2] > self._rim + config.free_height
            if not free or self._rng.uniform() > config.disturbance_rate:
                return np.zeros(6)
            self._disturbance = self._rng.uniform(-config.disturbance, config.disturbance, 6)
            self._disturbance[2] = abs(self._disturbance[2])  # upwards: a push down would ram the plug into the rim
            self._disturbed_steps = config.disturbance_steps
        self._disturbed_steps -= 1
        return self._disturbance

    def _press(self) -> Actions:
        """Press down and yield to sideways forces and tilts; wriggle where the plug sticks.

        It ends only where the plug does not enter the hole, or slides away.
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
            aside = self._aside(load)
            gently = self._tilt() > config.leaning * config.upright or self._is_on_top() or aside.any()
            wanted = [0, 0, config.feel_press if gently else self._press_force(stuck)]
            move = np.clip(config.compliance * (load - wanted), -config.force_step, config.force_step)
            if aside.any():
                move[:2] = aside  # must overcome the friction under the plug
            if stuck > config.wriggle_after:
                angle = config.wriggle_rate * step
                move[:2] += config.wriggle * np.array([np.cos(angle), np.sin(angle)])
            command, _ = skills.commanded
            facing = self._twisted(stuck) * self._facing(STRAIGHT)
            yield skills.command(command + move, skills.towards(facing, config.turn_rate))

    def _press_force(self, stuck: int) -> float:
        """Downward force, in N, on a plug that has not advanced for `stuck` steps."""
        config = self.config
        unloaded = stuck // config.unload_every % 2 == 1
        return config.light_press if unloaded and config.light_press is not None else config.press_force

    def _is_on_top(self) -> bool:
        """Whether the plug's end has not entered the hole."""
        return bool(self._place(self._end)[2] > self._rim - self.config.entered)

    def _aside(self, load: np.ndarray) -> np.ndarray:
        """Sideways motion (2,), in m per step, of a plug that is pressed."""
        return np.zeros(2)

    def _is_outside(self, stuck: int) -> bool:
        """Whether the plug's end has slid away from the socket, or has been on the rim for too long."""
        end = self._place(self._end)
        astray = np.linalg.norm((end - self.socket)[:2]) > self.config.astray
        return bool(astray or (stuck > self.config.patience and self._is_on_top()))

    def _twisted(self, stuck: int) -> Rotation:
        """Rotation about the vertical that a plug is given when it has not advanced for `stuck` steps."""
        swing = self.config.twist * min(1 + stuck / self.config.twist_growth, 2.0)
        return Rotation.from_euler("z", swing * np.sin(self.config.twist_rate * stuck))
