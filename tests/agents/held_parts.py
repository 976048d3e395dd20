"""Measures how the pads hold each task's part: `python -m tests.agents.held_parts` prints the table of docs/sensor.md."""

from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import sapien
import torch
from mani_skill.utils.structs import Pose
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

import manifeel_ms3  # noqa: F401
from manifeel_ms3.sensors.registry import DEFAULT_SENSOR

GRIP = 20.0  # N, force of each pad on parts that the task itself does not put into the hand
BALL_INDENTATION, BATTERY_INDENTATION = 2.5e-3, 6e-4  # m, under that grip
PUSHER = (0.005, 0.003, 0.001)  # m, half size: it fits between the pads
PUSHER_SPEED, APPROACH_SPEED, PUSHER_START = 0.012, 0.05, 0.045  # m/s, m/s, m beside the tool
TURNED, SHIFTED = np.deg2rad(10.0), 2e-3  # rad, m: slips at which the push ends
FLAT_TORQUE_RATE, ROUND_TORQUE_RATE = 0.2, 0.02  # N m/s: about two seconds to the slip
SLIPPED, MOST_TORQUE = np.deg2rad(1.0), 1.5  # rotation from which on the part slips, rad; largest torque, N m
CREEP_SHARE = 0.9  # torque of the test of creep, as a share of the slip torque
RAMP, CREEP_TIME, REST = 0.5, 1.0, 0.5  # s


@dataclass(frozen=True)
class Kind:
    """One of the parts that a task holds."""

    task: str
    actor: str
    """Attribute of the environment that holds the part."""
    lever: float
    """Distance of the place that is pushed from the pads' middle, along the fingers, in m."""
    half_width: float | None = None
    """Half the distance between the pads, in m, on a part that does not start in the hand, with the gels indented."""
    grip: float = GRIP
    """Force of each pad, in N, with which it is held."""
    is_regripped: bool = False
    """Whether it is held with `grip` in place of the force that its screwing task grips it with."""
    is_round: bool = False
    """Whether its surface between the pads is round, so that it slips at a smaller torque than flat parts."""

    @property
    def torque_rate(self) -> float:
        """Growth of the torque in the test of slip, in N m/s."""
        return ROUND_TORQUE_RATE if self.is_round else FLAT_TORQUE_RATE


KINDS = {
    "peg": Kind("PegInsertion", "plug", 0.035),
    "USB plug": Kind("USBInsertion", "plug", 0.040),
    "power plug": Kind("PowerPlugInsertion", "plug", 0.030),
    "gear": Kind("GearAssembly", "plug", 0.040),
    "reorientation peg": Kind("PegReorientation", "plug", 0.039),
    "nut": Kind("NutBoltAssembly", "held", 0.005, is_regripped=True),
    "bulb": Kind("BulbInstallation", "held", 0.060, grip=14.2, is_round=True),
    "battery": Kind("ObjectSearch", "battery", 0.010, 0.0125 - BATTERY_INDENTATION),
    "golf ball": Kind("BallSorting", "golf", 0.012, 0.02075 - BALL_INDENTATION, is_round=True),
    "table-tennis ball": Kind("BallSorting", "tennis", 0.012, 0.02075 - BALL_INDENTATION, is_round=True),
}


class HeldPart:
    """One part between the pads, in its task's own scene."""

    def __init__(self, name: str, sensor: str = DEFAULT_SENSOR):
        self.name, self.kind = name, KINDS[name]
        kind, settings = self.kind, dict(obs_mode="none", render_backend="none", sim_backend="physx_cpu", sensor=sensor)
        self._wrapped = gym.make(f"ManiFeel-{kind.task}-v1", **settings)
        self.env: Any = self._wrapped.unwrapped
        if kind.is_regripped:
            self.env.screw = replace(self.env.screw, grip_force=kind.grip)

    def close(self) -> None:
        self._wrapped.close()

    def reset(self, seed: int) -> None:
        """Start an episode with the part in the hand, and let it come to rest."""
        self._wrapped.reset(seed=seed)
        self.actor = getattr(self.env, self.kind.actor)
        if self.kind.half_width is not None:
            tool = Pose.create_from_pq(torch.tensor([[0.5, 0.0, 0.3]]), torch.tensor([[0.0, 1.0, 0.0, 0.0]]))
            self.env.agent.reset_tool(tool, self.kind.half_width, GRIP)
            self.actor.set_pose(tool)
        self._body = self.actor._objs[0].find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)
        self._body.max_angular_velocity = 1e4  # the engine clamps external torques by it
        self.run(REST)
        self._start = self._pose_in_tool()

    @property
    def rate(self) -> int:
        """Physics steps per second."""
        return self.env.physics_rate

    @property
    def mass(self) -> float:
        """Mass of the part, in kg."""
        return self._body.mass

    def run(self, seconds: float, torque: float = 0.0) -> None:
        """Simulate, with an external torque on the part about the closing axis, in N m."""
        closing = self._tool()[1].apply([0.0, 1.0, 0.0])
        for _ in range(round(seconds * self.rate)):
            if torque:
                self._body.add_force_torque(np.zeros(3, np.float32), np.float32(torque * closing))
            self.env.scene.step()

    def slip_torque(self) -> float:
        """Torque about the closing axis, in N m, at which the part slips, when it grows slowly."""
        torque = 0.0
        while self.turned < SLIPPED and torque < MOST_TORQUE:
            torque += self.kind.torque_rate / self.rate
            self.run(1 / self.rate, torque)
        return torque

    def creep(self, torque: float) -> float:
        """Rotation in the hand, in rad, in a second under a steady torque that was applied slowly before."""
        for step in range(round(RAMP * self.rate)):
            self.run(1 / self.rate, torque * step / (RAMP * self.rate))
        self.run(REST, torque)
        before = self.turned
        self.run(CREEP_TIME, torque)
        return abs(self.turned - before)

    def push(self) -> tuple[float, float, float, float]:
        """Push the part near its end with an edge until it has slipped, and remove the edge.

        Returns:
            Rotation in the hand, in rad, and displacement between the pads, in m, of the slip; and how much of each is undone.
        """
        scene, (tool, facing) = self.env.scene.sub_scenes[0], self._tool()
        along = facing.apply([1.0, 0.0, 0.0])
        place = tool + facing.apply([-PUSHER_START, 0.0, self.kind.lever])
        builder = scene.create_actor_builder()
        builder.add_box_collision(half_size=PUSHER)
        builder.set_physx_body_type("kinematic")
        builder.initial_pose = sapien.Pose(place)
        pusher = builder.build("pusher")
        body = pusher.find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)
        touched, way = False, 0.0
        while self.turned < TURNED and self.shifted < SHIFTED and way < 2 * PUSHER_START:
            touched = touched or self._touches(pusher)
            way += (PUSHER_SPEED if touched else APPROACH_SPEED) / self.rate
            body.set_kinematic_target(sapien.Pose(place + way * along))
            self.env.scene.step()
        turned, shifted, held = self.turned, self.shifted, self._point_between_pads()
        scene.remove_entity(pusher)
        self.run(REST)
        return turned, shifted, abs(turned - self.turned), float(np.linalg.norm(held - self._point_between_pads()))

    @property
    def turned(self) -> float:
        """Rotation of the part in the hand since it came to rest, in rad."""
        return (self._pose_in_tool()[1] * self._start[1].inv()).magnitude()

    @property
    def shifted(self) -> float:
        """Displacement, in m, of the point of the part that was in the pads' middle."""
        return float(np.linalg.norm(self._point_between_pads()))

    def _point_between_pads(self) -> np.ndarray:
        position, rotation = self._pose_in_tool()
        return position + rotation.apply(self._start[1].inv().apply(-self._start[0]))

    def _pose_in_tool(self) -> tuple[np.ndarray, Rotation]:
        return _split(self.env.agent.tcp.pose.inv() * self.actor.pose)

    def _tool(self) -> tuple[np.ndarray, Rotation]:
        return _split(self.env.agent.tcp.pose)

    def _touches(self, entity: sapien.Entity) -> bool:
        pairs = (contact for contact in self.env.scene.sub_scenes[0].get_contacts() if contact.points)
        return any(entity in (body.entity for body in contact.bodies) for contact in pairs)


def _split(pose: Pose) -> tuple[np.ndarray, Rotation]:
    raw = pose.raw_pose[0].numpy().astype(float)
    return raw[:3], Rotation.from_quat(raw[[4, 5, 6, 3]])


def main(seeds: range = range(3)) -> None:
    table = Table("part", "mass, g", "grip, N", "slips at, N m", "creeps at 90 %, degrees/s", "springs back, degrees", "mm")
    for name, kind in KINDS.items():
        part, rows = HeldPart(name), []
        for seed in seeds:
            part.reset(seed)
            torque = part.slip_torque()
            part.reset(seed)
            creep = part.creep(CREEP_SHARE * torque)
            part.reset(seed)
            *_, angle, distance = part.push()
            rows.append((torque, np.rad2deg(creep), np.rad2deg(angle), 1e3 * distance))
        least, (most, *worst) = np.min(rows, axis=0)[0], np.max(rows, axis=0)
        figures = (f"{value:.2f}" for value in worst)
        table.add_row(name, f"{1e3 * part.mass:.1f}", f"{kind.grip:.0f}", f"{least:.2f} to {most:.2f}", *figures)
        part.close()
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
