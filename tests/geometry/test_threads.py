"""A nut and a bolt, by their threads' contacts alone."""

import numpy as np
import pytest
import sapien
from scipy.spatial.transform import Rotation

from manifeel_ms3.geometry.threads import M16, external_mesh, m16_bolt, m16_nut
from tests.sensors.bench import PadBench

RATE = 480  # Hz: at 240 the nut tilts and jams
SPEED, GAIN, TORQUE = np.pi, 2e-3, 0.05  # rad/s, N m s, N m


class Screwing:
    """A nut on a bolt, turned by a torque, pushed by a force."""

    def __init__(self):
        def build(env):
            bolt = m16_bolt().build(env.scene, "kinematic", sapien.Pose([0.5, 0, 0]))
            return [bolt, m16_nut().build(env.scene, "dynamic", sapien.Pose([0.5, 0, M16.length - 5e-4]))]

        rates = dict(sim_freq=RATE, control_freq=10, scene_config=dict(contact_offset=2e-4))
        self.env = PadBench(build, obs_mode="none", render_backend="none", sim_config=rates)
        self.env.reset(seed=0)
        self.nut = self.env.objects[1]
        self.turned, self._yaw = 0.0, self._measure()

    @property
    def _axes(self) -> Rotation:
        return Rotation.from_quat(self.nut.pose.q[0].numpy()[[1, 2, 3, 0]])

    def _measure(self) -> float:
        x = self._axes.apply([1, 0, 0])
        return float(np.arctan2(x[1], x[0]))

    @property
    def height(self) -> float:
        return float(self.nut.pose.p[0, 2])

    @property
    def tilt(self) -> float:
        return float(np.arccos(np.clip(self._axes.apply([0, 0, 1])[2], -1, 1)))

    def run(self, seconds: float, speed: float | None, push: float) -> None:
        """Turn at a speed (rad/s; None: let it be), pushing down, N."""
        before = self.turned
        for _ in range(round(seconds * RATE)):
            rate, before = (self.turned - before) * RATE, self.turned
            torque = 0.0 if speed is None else float(np.clip(GAIN * (speed - rate), -TORQUE, TORQUE))
            self.nut._bodies[0].add_force_torque([0, 0, -push], [0, 0, torque])
            self.env.scene.step()
            yaw = self._measure()
            self.turned += (yaw - self._yaw + np.pi) % (2 * np.pi) - np.pi
            self._yaw = yaw


def test_nut_follows_the_pitch_stays_under_a_push_and_comes_off():
    screwing = Screwing()
    screwing.run(2.0, -SPEED, 1.0)  # until the thread has caught
    turned, height = screwing.turned, screwing.height
    screwing.run(5.0, -SPEED, 1.0)
    turns = (turned - screwing.turned) / (2 * np.pi)
    assert turns > 1.0
    assert (height - screwing.height) / turns == pytest.approx(M16.pitch, rel=0.10)
    assert screwing.tilt < np.deg2rad(2)

    screwing.run(0.3, 0.0, 0.0)
    turned, height = screwing.turned, screwing.height
    screwing.run(2.0, None, 20.0)
    assert abs(screwing.height - height) < 2e-4
    assert abs(screwing.turned - turned) < 0.05

    screwing.run(12.0, SPEED, 0.0)
    assert screwing.height > M16.length - 2e-3 or screwing.tilt > 0.2  # off the thread
    screwing.env.close()


def test_thread_has_its_radii_and_no_holes():
    mesh = external_mesh(M16)
    radius = np.linalg.norm(mesh.vertices[:, :2], axis=1)
    assert radius.max() == pytest.approx(0.008, abs=1e-9)
    assert M16.minor_radius == pytest.approx(0.008 - 0.5413 * 0.002, abs=3e-6)  # ISO 68-1: 5/8 of the triangle's height
    edges, count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    assert len(edges) > 1000
    assert (count % 2 == 0).all()
    assert np.pi * M16.minor_radius**2 * M16.length < mesh.volume < np.pi * 0.008**2 * M16.length
