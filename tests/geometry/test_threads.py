"""Parts that screw together, by their threads' contacts alone."""

import numpy as np
import pytest
import sapien
import torch
from scipy.spatial.transform import Rotation

from manifeel_ms3.geometry.screws import BOLT_FOOT, BOLT_TURN, E27, M16, NUT_HEIGHT, NUT_MOUTH, bulb_yaw
from manifeel_ms3.geometry.threads import external_mesh, internal_mesh, iso_metric, ridge
from manifeel_ms3.tasks.screwing.base import ScrewingEnv
from manifeel_ms3.tasks.screwing.bulb_installation import BulbInstallationEnv
from manifeel_ms3.tasks.screwing.nut_bolt_assembly import NutBoltAssemblyEnv
from manifeel_ms3.verification.press import PadBench


def nut_on_thread(height: float) -> float:
    """Yaw at which the nut's ridge lies in the middle of the bolt's groove."""
    return BOLT_TURN + 2 * np.pi * (height + NUT_MOUTH - NUT_HEIGHT / 2 - BOLT_FOOT) / M16.pitch


class Screwing:
    """A held part on its thread, turned by a torque, pushed by a force; a stiff hand keeps it upright if asked to."""

    def __init__(self, task: type[ScrewingEnv], height: float, yaw: float, torque: float, upright: float = 0.0):
        screw, self.rate = task.screw, task.physics_rate

        def build(env):
            fixed = screw.fixed.build(env.scene, "kinematic", sapien.Pose([0.5, 0, 0]))
            return [fixed, screw.held.build(env.scene, "dynamic", sapien.Pose([0.5, 0, 0.3]))]

        rates = dict(sim_freq=self.rate, control_freq=10, scene_config=task.contacts)
        self.env = PadBench(build, obs_mode="none", render_backend="none", sim_config=rates)
        self.env.reset(seed=0)
        self.held = self.env.objects[1]
        self.held.set_pose(sapien.Pose([0.5, 0, height], Rotation.from_euler("z", yaw).as_quat()[[3, 0, 1, 2]]))
        self.held.set_linear_velocity(torch.zeros(1, 3))
        self.held.set_angular_velocity(torch.zeros(1, 3))
        self.torque, self.upright = torque, upright
        self.turned, self._yaw = 0.0, self._measure()

    @property
    def _axes(self) -> Rotation:
        return Rotation.from_quat(self.held.pose.q[0].numpy()[[1, 2, 3, 0]])

    def _measure(self) -> float:
        x = self._axes.apply([1, 0, 0])
        return float(np.arctan2(x[1], x[0]))

    @property
    def height(self) -> float:
        return float(self.held.pose.p[0, 2])

    @property
    def tilt(self) -> float:
        return float(np.arccos(np.clip(self._axes.apply([0, 0, 1])[2], -1, 1)))

    def run(self, seconds: float, speed: float | None, push: float) -> None:
        """Turn the part at a speed, in rad/s, or let it turn freely if None, while a force pushes it down, in N."""
        before = self.turned
        body = self.held._bodies[0]
        for _ in range(round(seconds * self.rate)):
            rate, before = (self.turned - before) * self.rate, self.turned
            gain = 0.5 * self.rate * body.inertia[2]  # half of what is missing, in one step
            torque = np.zeros(3)
            torque[2] = 0.0 if speed is None else np.clip(gain * (speed - rate), -self.torque, self.torque)
            up = self._axes.apply([0, 0, 1])
            torque[:2] += self.upright * (np.cross(up, [0, 0, 1])[:2] - 4e-3 * body.angular_velocity[:2])
            body.add_force_torque([0, 0, -push], torque)
            self.env.scene.step()
            yaw = self._measure()
            self.turned += (yaw - self._yaw + np.pi) % (2 * np.pi) - np.pi
            self._yaw = yaw


def test_nut_follows_the_pitch_stays_under_a_push_and_comes_off():
    screw = NutBoltAssemblyEnv.screw
    top = screw.engaged - M16.pitch
    nut = Screwing(NutBoltAssemblyEnv, top, nut_on_thread(top), torque=0.05)
    nut.run(0.5, -2 * np.pi, 1.0)
    turned, height = nut.turned, nut.height
    nut.run(3.0, -3 * np.pi, 1.0)
    turns = (turned - nut.turned) / (2 * np.pi)
    assert turns > 1.0
    assert (height - nut.height) / turns == pytest.approx(M16.pitch, rel=0.10)
    assert nut.tilt < np.deg2rad(2)

    nut.run(0.3, 0.0, 0.0)
    turned, height = nut.turned, nut.height
    nut.run(0.3, None, -2.0)
    assert nut.height < screw.engaged - 1.5 * M16.pitch  # nor does a pull take it off
    nut.run(2.0, None, 20.0)
    assert abs(nut.height - height) < 2e-4
    assert abs(nut.turned - turned) < 0.05

    nut.run(6.0, 3 * np.pi, 0.0)
    nut.run(0.3, None, -1.0)
    assert nut.height > screw.engaged + 0.01  # nothing holds it any more
    nut.env.close()


def test_bulb_follows_the_pitch_and_gets_tight():
    screw = BulbInstallationEnv.screw
    start = screw.engaged - 0.0008
    bulb = Screwing(BulbInstallationEnv, start, bulb_yaw(start), torque=0.2, upright=0.5)
    bulb.run(0.1, -4 * np.pi, 2.0)
    turned, height = bulb.turned, bulb.height
    bulb.run(0.3, -4 * np.pi, 2.0)
    turns = (turned - bulb.turned) / (2 * np.pi)
    assert turns > 0.2
    assert (height - bulb.height) / turns == pytest.approx(E27.pitch, rel=0.10)  # its play is half a millimetre
    bulb.run(3.0, -4 * np.pi, 2.0)
    assert bulb.height == pytest.approx(screw.seated, abs=6e-4)
    turned = bulb.turned
    bulb.run(1.0, -4 * np.pi, 2.0)
    assert abs(bulb.turned - turned) < 0.2  # it does not go further
    bulb.env.close()


def test_thread_has_its_radii_and_no_holes():
    mesh = external_mesh(M16, 0.024, 0.006)
    radius = np.linalg.norm(mesh.vertices[:, :2], axis=1)
    assert radius.max() == pytest.approx(0.008, abs=1e-9)
    assert M16.minor_radius == pytest.approx(0.008 - 0.5413 * 0.002, abs=3e-6)  # ISO 68-1: 5/8 of the triangle's height
    edges, count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    assert len(edges) > 1000
    assert (count % 2 == 0).all()
    assert np.pi * 0.006**2 * 0.024 < mesh.volume < np.pi * 0.008**2 * 0.024


def test_edison_thread_is_the_standards():
    assert 2 * E27.major_radius == pytest.approx(26.25e-3, abs=0.2e-3)  # IEC 60061-1, 7004-21: 26.05 to 26.45
    assert 2 * E27.minor_radius == pytest.approx(24.06e-3, abs=0.2e-3)  # at most 24.26
    radii = np.array([radius for _, radius in E27.profile])
    assert np.abs(np.diff(radii)).max() < 0.6e-3  # arcs, without a step


def test_bore_is_the_thread_seen_from_inside():
    bore = E27.wider(2e-4)
    mesh = internal_mesh(bore, 0.012, bore.major_radius)
    radius = np.linalg.norm(mesh.vertices[:, :2], axis=1)
    assert radius.min() == pytest.approx(E27.minor_radius + 2e-4, abs=1e-9)
    assert radius.max() == pytest.approx(E27.major_radius + 2e-4, abs=1e-9)
    middle = mesh.triangles_center
    wall = np.abs(mesh.face_normals[:, 2]) < 0.5
    assert ((mesh.face_normals * middle)[:, :2].sum(1)[wall] < 0).all()  # it faces the axis


def test_ridge_runs_in_the_groove_of_its_thread():
    """Every corner of a ridge that is thinner than the groove keeps away from the thread's surface, all along it."""
    thread, play = iso_metric(0.008, 0.002), 1e-4
    half = thread.pitch / 8 - play
    section = np.array([[thread.minor_radius + 2e-4, side * half] for side in (-1, 1)])
    section[:, 1] += thread.pitch / 2 + 4 * thread.pitch
    corners = np.concatenate(ridge(section, thread.pitch, 2.0, 24))
    angle = np.arctan2(corners[:, 1], corners[:, 0])
    heights, radii = np.array(thread.profile).T
    surface = np.interp(corners[:, 2] - thread.pitch * angle / (2 * np.pi), heights, radii, period=thread.pitch)
    assert (np.linalg.norm(corners[:, :2], axis=1) - surface).min() > play
