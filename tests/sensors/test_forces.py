"""Touch through the engine's own contacts: known loads in, the same newtons out."""

import numpy as np
import pytest
import sapien
import torch
import trimesh

from manifeel_ms3.sensors.mechanics.contact import depth_below_face, solve_indentation
from manifeel_ms3.sensors.mechanics.wrench import WrenchGauge
from manifeel_ms3.sensors.registry import SENSORS
from manifeel_ms3.verification.press import PadBench, Press, indenter
from tests.sensors.shapes import thread_mesh
from tests.tasks_and_marks import needs_renderer

QUARTER_TURN = trimesh.transformations.rotation_matrix(np.pi / 4, [1, 0, 0])
BALL = 0.010  # m
INDENTERS = {  # builder, height of the body's origin over the face when it touches
    "sphere": (dict(radius=BALL), BALL),
    "cylinder": (dict(radius=0.006, half_length=0.006), 0.006),
    "box": (dict(half_size=[0.004, 0.005, 0.004]), 0.004),
    "edge": (dict(half_size=[0.006, 0.004, 0.004], rotation=QUARTER_TURN), 0.004 * np.sqrt(2)),
}


LOADS = (1.0, 3.0, 10.0, 30.0)  # N


@pytest.fixture(scope="module", params=[(sensor, shape) for sensor in SENSORS for shape in INDENTERS], ids="-".join)
def press(request):
    sensor, name = request.param
    shape, height = INDENTERS[name]
    press = Press(indenter(name, **shape), sensor=sensor)
    press.touching = height
    yield press
    press.close()


def assert_carries(figure, press: Press, normal: float, rows: float, cols: float) -> None:
    sums, wrench = press.sums, press.wrench
    figure("field's normal sum against the engine's, share", abs(sums[0] / wrench[0] - 1), at_most=0.01)
    figure("field's shear sums against the engine's, share", np.abs(sums[1:3] / wrench[1:3] - 1).max(), at_most=0.01)
    off = abs(sums[3] - wrench[3])
    figure("field's moment against the engine's, share, or mm", min(off / abs(wrench[3]), 1e3 * off / normal), at_most=0.01)
    bottoms_out = normal > 20 and press.touching == BALL  # one contact point of 8 kN/m: the housing behind takes its share
    if not bottoms_out:
        assert wrench[:3] == pytest.approx([normal, rows, cols], rel=0.01, abs=0.005 * normal)
        figure(
            "field's moment against the applied, over the load, mm",
            1e3 * abs(sums[3] - press.applied[3]) / normal,
            at_most=0.1,
        )


def test_sums_are_the_load_and_the_engines_wrench(press, figure):
    for force in LOADS:
        press.place(press.touching + 2e-4, 1e-3, -2e-3)
        twist = 0.0 if press.touching == BALL else 4e-4 * force  # a ball on a point contact would spin
        press.push(force, 0.25 * force, -0.15 * force, twist)
        assert_carries(figure, press, force, 0.25 * force, -0.15 * force)
        figure("centre of pressure against the force on the pad, mm off", 1e3 * press.centre_error, at_most=0.5)
        if press.touching == BALL and force < 20:  # beyond, it sinks in the engine until it touches more than the gel's face
            figure("centre of pressure against the ball's middle, mm off", 1e3 * press.ball_error, at_most=0.01)
        limit = press.sensor.config.gel.friction * press.field[..., 0]
        assert (np.linalg.norm(press.field[..., 1:], axis=-1) <= limit + 1e-6).all()


@needs_renderer
def test_a_thread_carries_the_load_on_its_crests(tmp_path, figure):
    mesh = thread_mesh()
    mesh.export(tmp_path / "thread.obj")

    def build(env):
        builder = env.scene.create_actor_builder()
        along = sapien.Pose(q=[np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
        builder.add_cylinder_collision(along, radius=0.008, half_length=0.010)
        builder.add_visual_from_file(str(tmp_path / "thread.obj"))
        builder.set_mass_and_inertia(0.1, sapien.Pose(), [1e-4] * 3)
        builder.initial_pose = sapien.Pose([0, 0, 2])
        return [builder.build("thread")]

    press = Press(build, render_backend="cpu")
    press.touching = 0.008
    for force in (1.0, 3.0, 10.0, 30.0):
        press.place(0.0082)
        press.push(force, 0.2 * force, 0.1 * force, 2e-4 * force)
        assert_carries(figure, press, force, 0.2 * force, 0.1 * force)
    press.close()


# hand pitched about the pads' normal by so many degrees: joints 2, 4 and 6
ARMS = {
    0: (-0.2086, -2.2905, 2.0819),
    45: (-0.2086, -2.2905, 1.2965),
    90: (-0.2086, -2.2905, 0.5111),
    135: (0.0655, -2.2905, 0.0),
    180: (0.6, -2.5416, 0.0),
    -135: (-0.2086, -1.5526, 3.7),
    -90: (-0.2086, -2.2905, 3.6527),
    -45: (-0.2086, -2.2905, 2.8673),
}


class HoldBench(PadBench):
    """A block held between both pads, the hand turned about their normal."""

    arm = ARMS[0]

    def _initialize_task(self, env_idx):
        qpos = torch.tensor(self.agent.keyframes["tool_down"].qpos, dtype=torch.float32)[None]
        qpos[0, [1, 3, 5]] = torch.tensor(self.arm)
        qpos[:, 7:] = 0.006 - 5e-4
        self.agent.reset(qpos, 20.0)
        self.objects[0].set_pose(self.agent.tcp.pose)


@pytest.mark.parametrize("mass", [0.01, 0.05, 0.1, 0.2])
def test_fingers_feel_the_weight_of_what_they_hold(mass, figure):
    def build(env):
        builder = env.scene.create_actor_builder()
        builder.add_box_collision(half_size=[0.008, 0.006, 0.012])
        builder.set_mass_and_inertia(mass, sapien.Pose(), [1e-4 * mass] * 3)
        builder.initial_pose = sapien.Pose([0.5, 0, 0.5])
        return [builder.build("block")]

    control = dict(control_mode="pd_ee_delta_pose_fixed_gripper", reward_mode="none")
    env = HoldBench(build, obs_mode="tacff", render_backend="none", tactile_sensors=("left", "right"), **control)
    for env.arm in ARMS.values():
        env.reset(seed=0)
        for _ in range(5):
            obs, *_ = env.step(np.zeros(6))
        felt = np.zeros(3)
        for side in ("left", "right"):
            _, rows, cols = obs["sensor_data"][f"tactile_{side}"]["force_field"][0].sum((0, 1)).tolist()
            felt += env.agent.gels[side].pose.sp.to_transformation_matrix()[:3, :3] @ [rows, cols, 0.0]
        weight = 9.81 * mass
        figure("weight felt by both fingers, share off", abs(np.linalg.norm(felt) / weight - 1), at_most=0.01)
        lean = np.rad2deg(np.arctan2(np.linalg.norm(felt[:2]), -felt[2]))
        figure("weight's direction, degrees off", lean, at_most=5)
    env.close()


@pytest.fixture(scope="module")
def ball():
    press = Press(indenter("ball", radius=0.020))
    press.touching = 0.020
    yield press
    press.close()


def test_stuck_area_shrinks_as_the_closed_form(ball, figure):
    """Winkler paraboloid: stuck share of the area = sqrt(1 - Q / mu P)."""
    ball.place(0.0202)
    ball.push(8.0)
    model, ones = ball.sensor.model, torch.ones(1, dtype=torch.float64)
    gel, grid = ball.sensor.config.gel, model.grid
    for share in (0.12, 0.3, 0.5):  # beyond 0.65, the engine's own contact slides
        ball.push(8.0, share * 8.0 * gel.friction)
        height = ball.sensor._depth.heights(model.cells)
        plane = solve_indentation(height, ball.sensor.wrench(), grid, gel.normal_stiffness * ones)
        depth = depth_below_face(height.double(), plane, grid.x, grid.y)[0]
        limit = gel.friction * gel.normal_stiffness * depth
        touching = depth > 0
        stuck = touching & (gel.shear_stiffness * model._bristle[0].norm(dim=-1) < 0.999 * limit)
        off = abs((stuck.sum() / touching.sum()).item() - np.sqrt(1 - share))
        figure("stuck share of a pressed ball, off the closed form", off, at_most=0.03)


def test_held_shear_does_not_drift_and_unloading_dissipates(ball, figure):
    ball.place(0.0202)
    ball.push(8.0)
    path = []
    for shear in (1.0, 2.0, 3.0, 4.0):
        ball.push(8.0, shear, seconds=0.1)
        path.append(ball.field[..., 1].copy())
    held = ball.field.copy()
    ball.push(8.0, 4.0, seconds=10.0)
    figure("drift of a shear held for 10 s, share", np.abs(ball.field - held).max() / np.abs(held).max(), at_most=0.01)
    for shear in (3.0, 2.0, 1.0, 0.0):
        ball.push(8.0, shear, seconds=0.1)
        path.append(ball.field[..., 1].copy())
    assert np.abs(path[1] - path[5]).max() > 0.02 * path[1].max()  # 2 N on the way up and on the way back
    assert np.abs(path[-1]).max() > 0.01 * path[3].max()  # and some stays locked in at no load
    for shear in (-4.0, 4.0, -4.0, 4.0):  # after the first turn the loop is closed
        ball.push(8.0, shear, seconds=0.2)
        path[0] = ball.field[..., 1].copy()
    ball.push(8.0, -4.0, seconds=0.2)
    ball.push(8.0, 4.0, seconds=0.2)
    assert np.abs(ball.field[..., 1] - path[0]).max() < 0.02 * path[0].max()


def test_release_clears_and_reset_clears(ball):
    ball.place(0.0202)
    ball.push(8.0, 3.0)
    assert np.abs(ball.field[..., 1]).max() > 0.05
    ball.sensor.reset(torch.arange(1))
    assert (ball.sensor.model._bristle == 0).all()
    ball.push(8.0, 3.0)
    ball.place(0.030)
    ball.sensor.capture()
    assert (ball.field == 0).all()


def test_twist_gives_an_antisymmetric_swirl(figure):
    press = Press(indenter("box", half_size=[0.005, 0.005, 0.004]))
    press.place(0.0042)
    press.push(10.0, twist=0.01)
    swirl = press.field[..., 1:]
    assert press.sums[3] == pytest.approx(0.01, rel=0.01)
    uneven = np.abs(swirl + swirl[::-1, ::-1]).max() / np.abs(swirl).max()
    figure("swirl of a twist, share that is not antisymmetric", uneven, at_most=0.05)
    press.close()


def test_field_does_not_depend_on_control_or_physics_rate(figure):
    fields = []
    for sim_freq, control_freq in ((240, 5), (240, 10), (240, 20), (120, 10)):
        rates = dict(sim_config=dict(sim_freq=sim_freq, control_freq=control_freq))
        press = Press(indenter("box", half_size=[0.006, 0.006, 0.004]), upright=False, **rates)
        press.place(0.0041)
        press.push(8.0)
        press.push(8.0, 1.5, seconds=0.8)
        press.push(8.0, 0.5, seconds=0.8)
        fields.append(press.field)
        press.close()
    normal, shear = np.abs(fields[0][..., 0]).max(), np.abs(fields[0][..., 1:]).max()
    for field in fields[1:]:
        off = np.abs(field - fields[0])
        figure("field at other rates, share off", max(off[..., 0].max() / normal, off[..., 1:].max() / shear), at_most=0.03)


@pytest.mark.parametrize("units", ["newton", "tacsl"])
def test_pictures_show_a_touch_in_any_unit(units):
    press = Press(indenter("box", half_size=[0.006, 0.006, 0.004]), upright=False, tactile={"units": units})
    press.place(0.0042)
    press.push(20.0)
    touched = press.sensor.get_obs()["force_field"]
    pictures = [press.sensor.get_images(dict(force_field=field))["force_field"] for field in (0 * touched, touched)]
    press.close()
    untouched, seen = (picture.numpy().astype(int) for picture in pictures)
    assert np.abs(seen - untouched).max() > 100  # of 255


def test_tacsl_units_give_penetration_and_speed():
    """A block that slides over the pad at a known speed v: the shear is 0.1 |v|, relative to the pad's motion."""
    press = Press(indenter("box", half_size=[0.006, 0.006, 0.004]), upright=False, tactile={"units": "tacsl"})
    press.place(0.0042)
    press.push(5.0)
    depth = press.sensor.get_obs()["penetration"][0]
    assert depth.max().item() == pytest.approx(5.0 / (9.5e7 * 0.012**2), rel=0.1)
    pad = press.env.agent.gels["right"].pose.sp.to_transformation_matrix()[:3, :3]
    press.body.set_linear_velocity(pad @ [0.002, -0.001, 0.0])
    press.body.set_angular_velocity([0, 0, 0])
    press.sensor.capture()
    field = press.field
    inside = depth.numpy() > 1e-4
    assert inside.sum() > 20
    pad_velocity = pad.T @ press.env.agent.gels["right"].linear_velocity[0].numpy()
    expected = 0.1 * (np.array([0.002, -0.001]) - pad_velocity[:2])  # of the object against the pad: it drags the gel along
    assert field[inside][:, 0] == pytest.approx(depth.numpy()[inside])
    assert np.abs(field[inside][:, 1:] - expected).max() < 2e-5
    assert np.abs(field[~inside]).max() < 2e-4  # m: no component exceeds twice the penetration
    press.close()


def test_same_state_and_history_same_output():
    runs = []
    for _ in range(2):
        press = Press(indenter("ball", radius=0.008), obs_mode="tacrgb+tacff", tactile={"optics.noise": 2.0})
        press.place(0.0081, 2e-3, 1e-3)
        press.push(4.0, 1.0, 0.5)
        runs.append(press.sensor.get_obs())
        press.close()
    assert runs[0].keys() == {"rgb", "force_field", "penetration"}
    for name, value in runs[0].items():
        assert torch.equal(value, runs[1][name]), name


def test_the_wrench_in_another_frame_is_that_of_the_same_load(make_env):
    env = make_env(obs_mode="none", render_backend="none")
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.full(6, 0.3))
    agent = env.unwrapped.agent
    frame = sapien.Pose([0.003, -0.005, 0.02], [0.5, 0.5, -0.5, 0.5])
    turn = frame.to_transformation_matrix()[:3, :3]
    own, other = (WrenchGauge(agent.robot, agent.gels["right"], at).read()[0].numpy() for at in (None, frame))
    assert np.abs(own[:3]).min() > 0.01
    assert other[:3] == pytest.approx(turn.T @ own[:3], abs=1e-5)
    assert other[3:] == pytest.approx(turn.T @ (own[3:] - np.cross(frame.p, own[:3])), abs=1e-6)
