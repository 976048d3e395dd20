"""Gears mesh through their teeth's contacts alone."""

import numpy as np
import pytest
import sapien
from scipy.spatial.transform import Rotation

from manifeel_ms3.geometry import gear_fit
from manifeel_ms3.geometry.gears import (
    BACKLASH,
    BASE_SIZE,
    MODULE,
    SHAFT_X,
    SHAFTS,
    TEETH,
    gear_base,
    neighbour_gear,
    tooth_polygon,
)
from manifeel_ms3.tasks.insertion.gear_assembly import GearAssemblyEnv
from manifeel_ms3.verification.press import PadBench

SPEED = 1.0  # rad/s


def test_turning_the_medium_gear_turns_its_neighbours_by_the_tooth_ratio():
    def build(env):
        base = gear_base().build(env.scene, "kinematic", sapien.Pose([0.5, 0, 0]))
        medium = gear_fit().plug.build(env.scene, "kinematic", sapien.Pose([0.5, 0, 1]))
        neighbours = [neighbour_gear(name).build(env.scene, "dynamic", sapien.Pose([0.5, 0, 1])) for name in ("small", "large")]
        return [base, medium, *neighbours]

    env = PadBench(build, obs_mode="none", render_backend="none", sim_config=dict(scene_config=GearAssemblyEnv.contacts))
    env.reset(seed=0)
    height, play = BASE_SIZE[2] + 1e-4, SHAFTS["paper"].bore - SHAFTS["paper"].shaft
    _, medium, *neighbours = env.objects
    gears = dict(zip(("small", "large"), neighbours, strict=True))
    for name, actor in gears.items():
        actor.set_pose(sapien.Pose([0.5 + SHAFT_X[name], 0, height]))

    def turned_to(angle: float) -> sapien.Pose:
        """A plug's z points down; its tooth at +x stays there."""
        turn = Rotation.from_euler("z", angle) * Rotation.from_euler("x", np.pi)
        return sapien.Pose([0.5, 0, height + gear_fit().reach], turn.as_quat()[[3, 0, 1, 2]])

    def yaw(actor) -> float:
        axis = Rotation.from_quat(actor.pose.q[0].numpy()[[1, 2, 3, 0]]).apply([1, 0, 0])
        return float(np.arctan2(axis[1], axis[0]))

    medium.set_pose(turned_to(0.0))
    last, turned, start = {name: yaw(actor) for name, actor in gears.items()}, dict.fromkeys(gears, 0.0), {}
    steps, way_back = 240 * 3, 120
    for step in range(steps):
        medium._bodies[0].set_kinematic_target(turned_to(SPEED * step / 240))
        env.scene.step()
        for name, actor in gears.items():
            now = yaw(actor)
            turned[name] += (now - last[name] + np.pi) % (2 * np.pi) - np.pi
            last[name] = now
        if step == way_back:
            start = dict(turned)  # the backlash is taken up
    for name, actor in gears.items():
        ratio = (turned[name] - start[name]) / (SPEED * (steps - 1 - way_back) / 240)
        assert ratio == pytest.approx(-TEETH["medium"] / TEETH[name], rel=0.05)
        away = np.linalg.norm(actor.pose.p[0].numpy() - [0.5 + SHAFT_X[name], 0, BASE_SIZE[2]])
        assert away < play + 5e-4  # still on its shaft
    env.close()


@pytest.mark.parametrize("teeth", TEETH.values())
def test_teeth_are_as_thick_as_they_should_be(teeth):
    """At the pitch circle: half the pitch, less the backlash."""
    outline = tooth_polygon(teeth)
    radius, angle = np.linalg.norm(outline, axis=1), np.arctan2(outline[:, 1], outline[:, 0])
    upper = angle > 0
    pitch = MODULE * teeth / 2
    order = np.argsort(radius[upper])
    half = np.interp(pitch, radius[upper][order], angle[upper][order])
    assert 2 * half * pitch == pytest.approx(np.pi * MODULE / 2 - BACKLASH, abs=1e-4)
    assert radius.max() == pytest.approx(pitch + MODULE)
