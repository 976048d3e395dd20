"""Objects pressed on the right pad by known forces, through the engine's own contacts."""

import numpy as np
import sapien
import torch
from mani_skill.utils.structs import Actor

from tests.sensors.bench import PadBench

SETTLE_SECONDS = 0.5
RAMP_SECONDS = 0.4
DRAG = 20.0  # N s/m; at rest it does nothing, while PhysX's own damping takes its share of a steady force, too
TWIST_DRAG = 0.01  # N m s
FRICTION = 0.8  # of an indenter: with the gel's 0.5 a contact has 0.65


def indenter(name: str, rotation: np.ndarray | None = None, **shape):
    """A builder of one body: a sphere, box or cylinder by the arguments of its collision shape."""

    def build(env: PadBench) -> list[Actor]:
        builder = env.scene.create_actor_builder()
        pose = sapien.Pose(rotation if rotation is not None else np.eye(4))
        rough = dict(material=sapien.physx.PhysxMaterial(FRICTION, FRICTION, 0.0))
        if "half_size" in shape:
            builder.add_box_collision(pose, **shape, **rough)
        elif "half_length" in shape:
            builder.add_cylinder_collision(pose, **shape, **rough)
        else:
            builder.add_sphere_collision(pose, **shape, **rough)
        builder.set_mass_and_inertia(0.1, sapien.Pose(), [1e-4] * 3)
        builder.initial_pose = sapien.Pose([0, 0, 2])
        return [builder.build(name)]

    return build


class Press:
    """A bench whose object hangs free, but for its tilt, locked if `upright`, and is pushed with what `push` says.

    The right pad's normal is the world's y axis, so that locking the turns about x and z leaves the twist about the normal.
    """

    def __init__(self, build, upright: bool = True, **kwargs):
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
        """Put the object's origin over a point of the pad, m; a new episode of touch begins."""
        self.env.place(self.actor, sapien.Pose([x, y, height]))
        self.body.set_linear_velocity([0, 0, 0])
        self.body.set_angular_velocity([0, 0, 0])
        self.load = np.zeros(4)
        self._last = self.actor.pose.sp
        self.sensor.reset(torch.arange(1))

    def push(
        self, normal: float, rows: float = 0.0, cols: float = 0.0, twist: float = 0.0, seconds: float | None = None
    ) -> None:
        """Change the load on the gel, N and N m, evenly to this one, sensing at the control rate, and let it settle."""
        target, start = np.array([normal, rows, cols, twist]), self.load
        rate, every = self.env._sim_freq, self.env._sim_steps_per_control
        ramp = round((RAMP_SECONDS if seconds is None else seconds) * rate)
        for step in range(ramp + round(SETTLE_SECONDS * rate)):
            self.load = start + (target - start) * min(1.0, (step + 1) / ramp)
            self._step()
            if (step + 1) % every == 0:
                self.sensor.capture()
        self.sensor.capture()

    def hold(self, seconds: float) -> None:
        for step in range(round(seconds * self.env._sim_freq)):
            self._step()
            if (step + 1) % self.env._sim_steps_per_control == 0:
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
        """(rows, cols, 3), N."""
        return self.sensor.get_obs()["force_field"][0].double().numpy()

    @property
    def sums(self) -> np.ndarray:
        """Normal, shear along rows and columns, N; moment about the normal, N m: of the field."""
        at = self.sensor.model.taxels.centres.numpy()
        moment = at[..., 0] * self.field[..., 2] - at[..., 1] * self.field[..., 1]
        return np.array([*self.field.sum((0, 1)), moment.sum()])

    @property
    def wrench(self) -> np.ndarray:
        """The engine's, as `sums`: normal into the gel."""
        w = self.sensor.wrench()[0].numpy()
        return np.array([-w[2], w[0], w[1], w[5]])

    def close(self) -> None:
        self.env.close()
