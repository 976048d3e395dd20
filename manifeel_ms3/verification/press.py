"""Objects pressed on the right pad by known forces, through the engine's own contacts.

Times, drags, masses and friction are set once; not tuned.
"""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false
# (ManiSkill and SAPIEN annotate poses and bodies by their base classes)
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.utils.structs import Actor

from manifeel_ms3.sensors.mechanics.contact import depth_below_face
from manifeel_ms3.tasks import VisuotactileEnv

SETTLE_SECONDS = 0.5
"""Time for which a load is held before it is read, in s."""
RAMP_SECONDS = 0.4
"""Time in which a load changes, in s."""
DRAG = 20.0
"""Drag of the pressed object, in N s/m. It has no effect at rest, where PhysX's own damping would take a share of the force."""
TWIST_DRAG = 0.01
"""Drag of the pressed object's rotation, in N m s."""
FRICTION = 0.8
"""Coulomb's friction coefficient of an indenter: averaged with the gel's 0.5, that of the contact is 0.65."""
LIFTED = 0.05
"""Height, in m, at which nothing touches the pad."""
MASS, INERTIA = 0.1, 1e-4
"""Mass, in kg, and moments of inertia, in kg m^2, of an indenter."""


@dataclass
class NoRandomization:
    """Randomization of a bench, which has nothing random."""


class PadBench(VisuotactileEnv):
    """The robot, with objects in front of its right pad; there are no rewards and no failures.

    Args:
        build: Function that adds actors to the environment, which become `objects`.
        kwargs: Arguments of `VisuotactileEnv`.
    """

    Randomization = NoRandomization
    default_control_mode = "pd_ee_delta_pose"

    def __init__(self, build: Callable[["PadBench"], list[Actor]] = lambda env: [], **kwargs):
        self._build = build
        super().__init__(sim_backend="physx_cpu", **kwargs)

    def _load_task(self):
        self.objects = self._build(self)

    def _initialize_task(self, env_idx):
        self.agent.reset(torch.tensor(self.agent.keyframes["tool_down"].qpos, dtype=torch.float32)[None])

    def place(self, actor: Actor, pose: sapien.Pose) -> None:
        """Set an actor's pose, given in the right pad's frame."""
        actor.set_pose(self.agent.gels["right"].pose.sp * pose)

    def measure(self):
        return {}

    def goal_reached(self, measures):
        return torch.zeros(self.num_envs, dtype=torch.bool)

    failed = goal_reached

    def _privileged_state(self):
        return {}


def indenter(name: str, rotation: np.ndarray | None = None, **shape) -> Callable[[PadBench], list[Actor]]:
    """Builder of one body: a sphere, a box or a cylinder, as the arguments of its collision shape tell.

    Args:
        name: Name of the body.
        rotation: Pose of the shape in the body, as a matrix (4, 4).
        shape: `radius` of a sphere, `half_size` of a box, or `radius` and `half_length` of a cylinder, in m.
    """

    def build(env: PadBench) -> list[Actor]:
        builder = env.scene.create_actor_builder()
        pose = sapien.Pose(rotation if rotation is not None else np.eye(4))
        rough: dict[str, Any] = dict(material=sapien.physx.PhysxMaterial(FRICTION, FRICTION, 0.0))
        if "half_size" in shape:
            builder.add_box_collision(pose, **shape, **rough)
        elif "half_length" in shape:
            builder.add_cylinder_collision(pose, **shape, **rough)
        else:
            builder.add_sphere_collision(pose, **shape, **rough)
        builder.set_mass_and_inertia(MASS, sapien.Pose(), [INERTIA] * 3)
        builder.initial_pose = sapien.Pose([0, 0, 2])
        return [builder.build(name)]

    return build


class Press:
    """A bench with an object that moves freely, or without tilting if `upright`; `push` applies a load to it.

    The right pad's normal is the world's y axis, so that an object whose rotations about x and z are locked can still twist
    about the normal.

    Args:
        build: Builder of the object.
        upright: Whether the object cannot tilt.
        kwargs: Arguments of `VisuotactileEnv`.
    """

    def __init__(self, build: Callable[[PadBench], list[Actor]], upright: bool = True, **kwargs):
        kwargs = dict(obs_mode="tacff", render_backend="none", control_mode="pd_ee_delta_pose_fixed_gripper") | kwargs
        self.env = PadBench(build, **kwargs)
        self.env.reset(seed=0)
        self.sensor = self.env._tactile_sensors["tactile_right"]
        self.actor = self.env.objects[0]
        self.body = self.actor._bodies[0]
        self.body.set_disable_gravity(True)
        self.body.set_locked_motion_axes([False, False, False, upright, False, upright])
        self.load = np.zeros(4)

    def place(self, height: float, x: float = 0.0, y: float = 0.0) -> None:
        """Put the object's origin over a point of the pad, and begin a new episode of the sensor.

        The object is lifted for one step, because the engine keeps the friction of a contact that is merely moved: after
        another load, a rod on the DIGIT's dome then slid off the gel.

        Args:
            height: Height over the untouched face, m.
            x: Position of the point across the finger, pad frame, m.
            y: Position of the point along the finger, pad frame, m.
        """
        self._rest_at(sapien.Pose([x, y, LIFTED]))
        self.env.scene.step()
        self._rest_at(sapien.Pose([x, y, height]))
        self.load = np.zeros(4)
        self._placed = np.array([x, y])
        self._last = self.actor.pose.sp
        self.sensor.reset(torch.arange(1))

    def _rest_at(self, pose: sapien.Pose) -> None:
        """Put the object at rest at a pose in the pad's frame."""
        self.env.place(self.actor, pose)
        self.body.set_linear_velocity([0, 0, 0])
        self.body.set_angular_velocity([0, 0, 0])

    def push(
        self, normal: float, rows: float = 0.0, cols: float = 0.0, twist: float = 0.0, seconds: float = RAMP_SECONDS
    ) -> None:
        """Change the load on the gel evenly to a new one, sensing at the control rate, and let it settle.

        Args:
            normal: Normal force into the gel, N.
            rows: Shear in the direction of rising row numbers, N.
            cols: Shear along columns, N.
            twist: Moment about the normal, N m.
            seconds: Time in which the load changes, s.
        """
        target, start = np.array([normal, rows, cols, twist]), self.load
        rate, every = self.env._sim_freq, self.env._sim_steps_per_control
        ramp = round(seconds * rate)
        for step in range(ramp + round(SETTLE_SECONDS * rate)):
            self.load = start + (target - start) * min(1.0, (step + 1) / ramp)
            self._step()
            if (step + 1) % every == 0:
                self.sensor.capture()
        self.sensor.capture()

    def _step(self) -> None:
        normal, rows, cols, twist = self.load
        rotation = self.env.agent.gels["right"].pose.sp.to_transformation_matrix()[:3, :3]
        pose = self.actor.pose.sp
        moved = (pose.p - self._last.p) * self.env._sim_freq  # the engine's velocity is not zero at rest on a compliant contact
        turn = (pose * self._last.inv()).q
        turned = 2 * turn[1:] * np.sign(turn[0]) * self.env._sim_freq
        self._last = pose
        self.body.add_force_torque(
            rotation @ [rows, cols, -normal] - DRAG * moved, rotation @ [0, 0, twist] - TWIST_DRAG * turned
        )
        self.env.scene.step()

    @property
    def field(self) -> np.ndarray:
        """Force field (rows, cols, 3), N."""
        return self.sensor.get_obs()["force_field"][0].double().numpy()

    @property
    def taxels(self) -> np.ndarray:
        """Centres (rows, cols, 2) of the taxels, m."""
        return self.sensor.model.taxels.centres.numpy()

    @property
    def sums(self) -> np.ndarray:
        """Sums (4,) over the field: normal force, shear along rows and columns, N, and moment about the normal, N m."""
        moment = self.taxels[..., 0] * self.field[..., 2] - self.taxels[..., 1] * self.field[..., 1]
        return np.array([*self.field.sum((0, 1)), moment.sum()])

    @property
    def wrench(self) -> np.ndarray:
        """Load (4,) that the engine carries through the pad's joint, in the order of `sums`; normal is into the gel."""
        w = self.sensor.wrench()[0].numpy()
        return np.array([-w[2], w[0], w[1], w[5]])

    @property
    def applied(self) -> np.ndarray:
        """Load (4,) that pushes the object, in the order of `sums`; its moment is about the pad's origin."""
        normal, rows, cols, twist = self.load
        x, y = self.at
        return np.array([normal, rows, cols, twist + x * cols - y * rows])

    @property
    def centre(self) -> np.ndarray:
        """Centre of pressure (2,) of the field, m."""
        field = self.field
        return (field[..., :1] * self.taxels).sum((0, 1)) / field[..., 0].sum()

    @property
    def centre_error(self) -> float:
        """Largest distance, along x or y, of the field's centre of pressure from that of the force on the pad, m."""
        wrench = self.sensor.wrench()[0].numpy()
        return float(np.abs(self.centre - np.array([wrench[4], -wrench[3]]) / -wrench[2]).max())

    @property
    def ball_error(self) -> float:
        """Largest distance, along x or y, of the field's centre of pressure from the middle of a ball, m.

        A ball presses where it is. Any other shape, whose tilt is locked, can carry a moment at its corners.
        """
        return float(np.abs(self.centre - self.at).max())

    @property
    def at(self) -> np.ndarray:
        """Position (2,) of the object's origin in the plane of the pad's face, m."""
        return (self.env.agent.gels["right"].pose.sp.inv() * self.actor.pose.sp).p[:2]

    @property
    def slid(self) -> float:
        """Distance of the object's origin along the face from where it was placed, m."""
        return float(np.linalg.norm(self.at - self._placed))

    @property
    def depth(self) -> np.ndarray:
        """Depth (C,), m, of the object in the gel at the cells of the contact model; negative outside the contact."""
        model = self.sensor.model
        height = model.heights(self.sensor._depth)
        plane = model.contact_plane(height, self.sensor.wrench())
        return depth_below_face(height.double(), plane, model.grid.x, model.grid.y)[0].numpy()

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()
