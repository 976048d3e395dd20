"""Demonstrators of the screwing tasks: set the thread down and turn; at the wrist's limit let go, turn back, grasp again."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from manifeel_ms3.tasks.registry import register_demonstrator
from manifeel_ms3.tasks.screwing.base import WOUND_UP, ScrewingEnv
from manifeel_ms3.tasks.screwing.bulb_installation import BulbInstallationEnv

from .skills import DOWNWARD, Actions, Skills, above, aside, perceived_position, position_rotation

STREAM = 17
"""Number beside the seed from which this demonstrator draws, so that its draws are not those of the task; arbitrary."""


@dataclass(frozen=True)
class ScrewingExpertConfig:
    """Constants of the demonstrators of the screwing tasks.

    Values without another origin were tuned by hand; docs/tasks.md has the success of both tasks over the seeds that it names.
    """

    hover_height: float = 0.010
    """Height over the first contact of the threads from which the part is lowered to contact, in m. Tuned."""
    clear_height: float = 0.020
    """Height above the end of an approach, in m, at which the hand may move sideways. Tuned."""
    travel_tolerance: float = 4e-3
    """Distance from the point at `clear_height` at which the hand goes on with the held part, in m. Tuned."""
    hover_tolerance: float = 1e-3
    """Distance from the point at `hover_height` at which the hand begins to lower the part, in m. Tuned."""
    approach_tolerance: float = 2e-3
    """Distance from the point over a part in its holder at which the hand goes down, in m. Tuned."""
    grasp_tolerance: float = 1.5e-3
    """Distance from the grasp position at which the fingers close, in m. Tuned."""
    lower_speed: float = 0.001
    """Speed at which the part is lowered to contact, in m per step. Tuned."""
    lower_distance: float = 0.02
    """Largest distance by which the part is lowered to contact, in m. Tuned."""

    centre_force: float = 4.0
    """Downward force while the chamfer centres the part, in N. Tuned."""
    centre_steps: int = 3
    """Number of steps between two checks of whether the part still sinks. Tuned."""
    centre_tries: int = 15
    """Number of checks after which even a part that stands on the rim is turned. Tuned."""
    centre_gain: float = 2.0
    """Compliance while the chamfer centres the part, as a multiple of `compliance`. Tuned."""
    sunk: float = 5e-5
    """Descent between two checks, in m, below which the part no longer sinks. Tuned."""
    on_thread: float = 0.0015
    """Height over the first contact of the threads, in m, above which the part is not on the thread yet. Tuned."""

    sweep: float = float(np.deg2rad(310))
    """Range of the hand's rotation, in rad; the last joint of the Panda has 332 degrees."""
    turn: float = 0.047
    """Rotation of the hand, in rad per step; the controller allows 0.05 (public code of the paper)."""
    slow_turn: float = 0.02
    """Largest rotation under torque, in rad per step. Tuned."""
    slow_torque: float = 0.03
    """Torque, in N m, above which the hand turns slower. Tuned."""
    tightening: float = float(np.deg2rad(40))
    """Rotation of the part once it is at its final height, in rad. Tuned."""
    tighten_torque: float = 0.16
    """Torque, in N m, at which the hand stops turning and holds: above the 0.1 N m that BulbInstallation asks for. Tuned."""
    turn_force: float = 1.5
    """Downward force while the hand turns, in N. Tuned."""
    release_force: float = np.inf
    """Upward force, in N, above which the hand may rise while it turns. The hand never rises where it is infinite."""
    compliance: float = 1.0e-4
    """Motion of the hand per step and per newton of unwanted force, in m/N. Tuned."""
    sideways_force: float = 1.0
    """Sideways force that the hand does not comply with, in N. Tuned."""
    force_step: float = 8e-4
    """Largest step under force, along each axis, in m. Tuned."""
    follow: float = 0.0
    """Share of the part's distance from the tool by which the hand follows it in one step while it turns."""
    straighten: float = 0.2
    """Share of its lean by which the part is straightened in one step. Tuned."""

    open_by: float = 0.007
    """Distance by which each finger moves away from the part to let go, in m. Tuned."""
    open_steps: int = 3
    """Number of steps in which the fingers open. Tuned."""
    close_steps: int = 4
    """Number of steps in which the fingers close after turning back. Tuned."""
    first_close_steps: int = 6
    """Number of steps in which the fingers close on a part in its holder. Tuned."""


@register_demonstrator("ManiFeel-NutBoltAssembly-v1")
class ScrewingExpert:
    """Knows the parts, sees roughly where the axis is, and acts on the loads that the pads sense.

    Three things are read from the simulator instead of from images: the position of the fixed part, with an error of up to
    `SkillConfig.sight_error`, and the held part's lean and its position in the hand, which give its height.

    Args:
        env: Environment that has just been reset.
        seed: Seed of the episode.
    """

    config = ScrewingExpertConfig()

    def __init__(self, env: ScrewingEnv, seed: int):
        self.env, self.screw = env, env.screw
        self.skills = Skills(env)
        self._closed = self.skills.grip_action(self.screw.grip_width, self.screw.grip_force)
        self._open = self.skills.finger_action(self.screw.grip_width / 2 + self.config.open_by)
        self.skills.gripper = self._closed
        self._rng = np.random.default_rng([seed, STREAM])
        self.axis = perceived_position(env.fixed, self._rng)
        self.yaw = WOUND_UP

    def _facing(self) -> Rotation:
        return Rotation.from_euler("z", self.yaw) * DOWNWARD

    def actions(self) -> Actions:
        """Actions of an episode, without end: once the part is tight, the demonstrator keeps holding it."""
        yield from self._begin()
        while True:
            yield from self._turn(WOUND_UP - self.config.sweep)
            yield from self._regrasp()

    def _begin(self) -> Actions:
        """Bring the part, held by the fingers, to where it can be turned."""
        yield from self._set_down()

    def _set_down(self) -> Actions:
        """Bring the held part over the axis, lower it until it touches, and let it find its place."""
        skills, config = self.skills, self.config
        yield skills.command(*skills.commanded)
        skills.tare()
        over = above(self.axis, self.screw.engaged + config.hover_height)
        yield from self._come_over(over)
        lowest = over[2] - config.lower_distance
        yield from skills.lower_until_contact(self._facing(), lowest, speed=config.lower_speed)
        yield from self._centre()

    def _come_over(self, end: np.ndarray) -> Actions:
        """Bring the tool to a point (3,), m, sideways first and then straight down."""
        skills, config = self.skills, self.config
        yield from skills.reach(above(end, config.clear_height), self._facing(), config.travel_tolerance)
        yield from skills.reach(end, self._facing(), config.hover_tolerance)

    def _centre(self) -> Actions:
        """Press, and comply with the chamfer's push, until the part no longer sinks and does not stand on the rim."""
        skills, config = self.skills, self.config
        gain = config.centre_gain * config.compliance
        lowest, deep_enough, tries = np.inf, self.screw.engaged + config.on_thread, 0
        while self._height() < lowest - config.sunk or (self._height() > deep_enough and tries < config.centre_tries):
            lowest, tries = self._height(), tries + 1
            for _ in range(config.centre_steps):
                move = gain * (skills.load - [0, 0, config.centre_force]) + self._straighten()
                command, _ = skills.commanded
                yield skills.command(command + np.clip(move, -config.force_step, config.force_step), self._facing())

    def _turn(self, end: float) -> Actions:
        """Turn clockwise until the hand has turned to `end`, in rad, lightly pressing and complying with sideways forces."""
        skills, config = self.skills, self.config
        while self.yaw > end:
            command, _ = skills.commanded
            load = skills.load
            load[:2] -= np.clip(load[:2], -config.sideways_force, config.sideways_force)
            move = config.compliance * (load - [0, 0, config.turn_force]) + self._straighten()
            move += config.follow * self._in_hand()
            move = np.clip(move, -config.force_step, config.force_step)
            turn = self._turn_rate()
            self.yaw -= turn
            move[2] -= self.screw.pitch * turn / (2 * np.pi)
            if load[2] < config.release_force:
                move[2] = min(move[2], 0.0)  # the part must not rise
            yield skills.command(command + move, self._facing())

    def _turn_rate(self) -> float:
        """Rotation of the next step, in rad: the slower, the larger the torque; 0 once the part is tight."""
        config, torque = self.config, self._torque()
        if torque < config.slow_torque:
            return config.turn
        left = (config.tighten_torque - torque) / (config.tighten_torque - config.slow_torque)
        return config.slow_turn * np.clip(left, 0.0, 1.0)

    def _straighten(self) -> np.ndarray:
        """Motion of the hand in one step, (3,), m, that turns a leaning part upright about the foot of its thread.

        The lean is read from the simulator.
        """
        leaning = position_rotation(self.env.held.pose.raw_pose)[1].apply([0.0, 0.0, 1.0])
        return -self.config.straighten * self.screw.reach * np.r_[leaning[:2], 0.0]

    def _torque(self) -> float:
        """Clockwise torque, in N m, of the hand on the part, as the pads sense it."""
        return -float(self.env.agent.torque_on_held(self.env.agent.tcp.pose.p)[0])

    def _height(self) -> float:
        """Height, in m, of the held part over the underside of the fixed one.

        It is taken from the tool's pose and the part's position in the hand.
        """
        tool, _ = self.skills.tool
        return float((tool + self._in_hand() - self.axis)[2])

    def _in_hand(self) -> np.ndarray:
        """Vector (3,), in m, from the tool to the held part. The part's position in the hand is read from the simulator."""
        in_hand = (self.env.agent.tcp.pose.inv() * self.env.held.pose).raw_pose[0, :3].cpu().numpy()
        return self.skills.tool[1].apply(in_hand)

    def _regrasp(self) -> Actions:
        """Let go, turn back as far as is needed or as the wrist allows, around the part, and close the fingers again."""
        skills, config = self.skills, self.config
        height = self._height()
        yield from skills.move_fingers(self._open, config.open_steps)
        here = skills.tool[0] + self._in_hand()
        left = (height - self.screw.seated) / self.screw.pitch * 2 * np.pi + config.tightening
        period = self.screw.symmetry
        back = self.yaw + period * np.clip(np.ceil(left / period), 1, np.floor(config.sweep / period))
        while self.yaw < back:
            self.yaw = min(self.yaw + config.turn, back)
            yield skills.command(here, self._facing())
        yield from skills.move_fingers(self._closed, config.close_steps)
        skills.tare()


@dataclass(frozen=True)
class BulbExpertConfig(ScrewingExpertConfig):
    """Constants of the demonstrator of BulbInstallation. Those with another value than for the nut are tuned."""

    tightening: float = float(np.deg2rad(120))
    """Rotation of the bulb once it is at its final height, in rad."""
    release_force: float = 4.0
    """Upward force, in N, above which the hand may rise while it turns: when the bulb meets the contact, the holder's thread
    must take the load, not the hand."""
    follow: float = 0.2
    """Share of the bulb's distance from the tool by which the hand follows it: a round part that slips between the pads would
    slip out of them."""
    aim_error: float = 0.015
    """Largest distance from the axis, in m, of the point at which the bulb begins to descend. Set once; not tuned."""
    centring: float = 0.2
    """Share of its distance from the axis by which the bulb is moved in one step of its descent. Set once; not tuned."""
    slope: float = 1.0
    """Smallest ratio of the height over the end of the descent to the distance from the axis: the bulb comes down within a
    cone. Set once; not tuned."""
    descent: float = 0.0015
    """Largest step downwards of the descent, in m. Set once; not tuned."""


@register_demonstrator("ManiFeel-BulbInstallation-v1")
class BulbExpert(ScrewingExpert):
    """Screws in a bulb that it holds, or one that already sits in the holder's thread (`start="holder"`).

    It comes roughly over the holder and moves to its axis while it descends, so that demonstrations show how a bulb beside the
    axis is brought to it.
    """

    config = BulbExpertConfig()
    env: BulbInstallationEnv

    def _come_over(self, end: np.ndarray) -> Actions:
        skills, config = self.skills, self.config
        aim = above(end, config.clear_height) + aside(self._rng, config.aim_error)
        yield from skills.reach(aim, self._facing(), config.travel_tolerance)
        while True:
            off = end - skills.tool[0]
            distance, height = np.linalg.norm(off[:2]), -off[2]
            if max(distance, height) < config.hover_tolerance:
                return
            near = distance <= max(config.hover_tolerance, height / config.slope)
            down = np.clip(height, 0.0, config.descent) if near else 0.0
            command, _ = skills.commanded
            yield skills.command(command + np.array([*config.centring * off[:2], -down]), self._facing())

    def _begin(self) -> Actions:
        yield from self._grasp_in_holder() if self.env.start == "holder" else self._set_down()

    def _grasp_in_holder(self) -> Actions:
        """Grasp the bulb that already sits in its thread."""
        skills, config = self.skills, self.config
        skills.gripper = 1.0
        place = above(self.axis, self.screw.engaged)
        yield from skills.reach(above(place, config.clear_height), self._facing(), config.approach_tolerance)
        yield from skills.reach(place, self._facing(), config.grasp_tolerance)
        yield from skills.move_fingers(self._closed, config.first_close_steps)
        skills.tare()
