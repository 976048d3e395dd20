"""Both depth backends against closed forms, and against each other."""

from pathlib import Path

import numpy as np
import pytest
import sapien
import torch
import trimesh
from mani_skill.envs.sapien_env import BaseEnv
from sapien.render import RenderMaterial
from scipy.spatial.transform import Rotation

from manifeel_ms3.errors import InvalidFileError, MachineError
from manifeel_ms3.geometry.containers import CONTAINER_HEIGHT, CONTAINER_OUTER, container
from manifeel_ms3.sensors import TactileSensor, sensor_config
from manifeel_ms3.sensors.depth.raycast import MeshRays, in_pad_frames
from manifeel_ms3.sensors.depth.surfaces import entity_mesh
from manifeel_ms3.verification.press import PadBench
from tests.tasks_and_marks import needs_renderer

from . import shapes

DEEP = 5e-4  # m into the gel
BALL, ROD, WEDGE = 0.008, 0.006, 0.005  # radii, and half the side of a bar on its edge, m
TILT = trimesh.transformations.rotation_matrix(np.pi / 4, [0, 1, 0])


def bar() -> trimesh.Trimesh:
    return trimesh.creation.box([2 * WEDGE, 0.02, 2 * WEDGE]).apply_transform(TILT)


def rod() -> trimesh.Trimesh:
    along = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    return trimesh.creation.cylinder(ROD, 0.02, sections=720).apply_transform(along)


def ball_height(x, y):
    return np.sqrt(np.maximum(BALL**2 - x**2 - y**2, 0)) - BALL


def rod_height(x, y):
    return np.where(np.abs(y) < 0.01, np.sqrt(np.maximum(ROD**2 - x**2, 0)) - ROD, -1)


def bar_height(x, y):
    return np.where(np.abs(y) < 0.01, -np.abs(x), -1)


def thread_heights(x, y):
    return np.where((np.abs(y) < 0.0099) & (np.abs(x) < 0.004), shapes.thread_height(x, y, shapes.THREAD_RADIUS), -1)


def dimple_height(x, y):
    return np.where((np.abs(x) < 0.0099) & (np.abs(y) < 0.0099), -shapes.dimples(x, y), -1)


SHAPES = {  # mesh, its origin over its lowest point, height over the face when that point touches it
    "ball": (lambda: trimesh.creation.icosphere(subdivisions=6, radius=BALL), BALL, ball_height),
    "rod": (rod, ROD, rod_height),
    "edge": (bar, WEDGE * np.sqrt(2), bar_height),
    "thread": (shapes.thread_mesh, shapes.THREAD_RADIUS, thread_heights),
    "dimples": (shapes.dimple_mesh, 0.0, dimple_height),
}


def bench(name: str, folder: Path, **kwargs) -> PadBench:
    """A bench with one of the shapes, which nothing moves."""
    path = folder / "shape.glb"
    SHAPES[name][0]().export(path)

    def build(env):
        builder = env.scene.create_actor_builder()
        builder.add_sphere_collision(radius=1e-3)
        builder.add_visual_from_file(str(path), material=RenderMaterial(base_color=[1, 0, 0, 1]))
        builder.initial_pose = sapien.Pose([0, 0, 2])
        return [builder.build_kinematic("shape")]

    return PadBench(build, obs_mode="rgb", cameras=("wrist",), **kwargs)


@pytest.fixture(scope="module", params=SHAPES)
def shape_env(request, tmp_path_factory):
    env = bench(request.param, tmp_path_factory.mktemp("mesh"))
    yield env, *SHAPES[request.param][1:]
    env.close()


def heights(env: PadBench, backend: str) -> tuple[np.ndarray, np.ndarray]:
    sensor = TactileSensor(sensor_config(env.sensor, "tactile", "gel_right", backend=backend), env.scene, env.agent.robot)
    env.scene.update_render()
    sensor._depth.look()
    return sensor._depth.heights(sensor.model.pixels)[0].numpy(), sensor.model.pixels.double().numpy()


@needs_renderer
@pytest.mark.parametrize("backend", ["raycast", "sapien"])
@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (5e-3, -9e-3), (-6e-3, 8e-3)])
def test_shapes_are_seen_within_five_micrometres(shape_env, backend, x, y, figure):
    env, origin, height = shape_env
    env.place(env.objects[0], sapien.Pose([x, y, origin - DEEP]))
    seen, pixels = heights(env, backend)
    expected = height(pixels[:, 0] - x, pixels[:, 1] - y) + DEEP
    near = expected > -1.5e-3
    error = (seen - expected)[near]
    assert near.sum() > 1000
    figure(f"shapes, {backend}, micrometres RMS off the closed form", 1e6 * np.sqrt((error**2).mean()), at_most=5)


@needs_renderer
def test_backends_agree_within_five_micrometres(shape_env, figure):
    env, origin, height = shape_env
    env.place(env.objects[0], sapien.Pose([1e-3, 2e-3, origin - DEEP]))
    rays, pixels = heights(env, "raycast")
    camera, _ = heights(env, "sapien")
    near = height(pixels[:, 0] - 1e-3, pixels[:, 1] - 2e-3) + DEEP > -1.5e-3
    figure("depth backends, micrometres RMS apart", 1e6 * np.sqrt(((rays - camera)[near] ** 2).mean()), at_most=5)


@needs_renderer
@pytest.mark.parametrize("sensor", ["gelsight_mini", "digit"])
@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_are_seen_over_the_face_of_other_sensors(shape, sensor, figure, tmp_path):
    _, origin, height = SHAPES[shape]
    env = bench(shape, tmp_path, sensor=sensor)
    x, y, curvature = 6e-3, -8e-3, sensor_config(sensor, "a", "b").gel.curvature[0]
    sag = (1 - np.sqrt(1 - curvature**2 * (x**2 + y**2))) / curvature if curvature else 0.0
    env.place(env.objects[0], sapien.Pose([x, y, origin - DEEP - sag]))
    for backend in ("raycast", "sapien"):
        pad = TactileSensor(sensor_config(sensor, "tactile", "gel_right", backend=backend), env.scene, env.agent.robot)
        env.scene.update_render()
        pad._depth.look()
        cells = pad.model.cells.double().numpy()
        r2 = (cells**2).sum(1)
        face = (1 - np.sqrt(1 - curvature**2 * r2)) / curvature if curvature else np.zeros(len(cells))
        expected = height(cells[:, 0] - x, cells[:, 1] - y) + DEEP + sag - face
        near = expected > -1e-3
        error = (pad.model.heights(pad._depth)[0].numpy() - expected)[near]
        assert near.sum() > 100
        figure(f"shapes over the {sensor}'s face, {backend}, micrometres RMS", 1e6 * np.sqrt((error**2).mean()), at_most=5)
    env.close()


def test_several_objects_and_the_table_are_felt_without_registration_or_renderer():
    def build(env):
        actors = []
        for name, size in (("cube", 2e-3), ("slab", 3e-3)):
            builder = env.scene.create_actor_builder()
            builder.add_box_collision(half_size=[size] * 3)
            builder.initial_pose = sapien.Pose([0, 0, 2])
            actors.append(builder.build_kinematic(name))
        return actors

    env = PadBench(build, obs_mode="tacff", render_backend="none")
    sensor = env._tactile_sensors["tactile_right"]
    env.place(env.objects[0], sapien.Pose([0, -8e-3, 2e-3 - 1e-4]))
    env.place(env.objects[1], sapien.Pose([0, 8e-3, 3e-3 - 3e-4]))
    sensor._depth.look()
    height = sensor._depth.heights(sensor.model.cells)[0].numpy()
    cells = sensor.model.cells.numpy()
    for centre, half, depth in ((-8e-3, 2e-3, 1e-4), (8e-3, 3e-3, 3e-4)):
        inside = (np.abs(cells[:, 1] - centre) < half - 5e-4) & (np.abs(cells[:, 0]) < half - 5e-4)
        assert np.abs(height[inside] - depth).max() < 5e-6
    names = {surface.body.name for surface in sensor._depth.surfaces}
    assert {"table", "cube", "slab", "gel_left"} <= names
    assert not names & {"gel_right", "panda_rightfinger", "panda_hand"}
    env.close()


class TwoRobotsEnv(BaseEnv):
    """Two equal robots that face each other."""

    SUPPORTED_ROBOTS = [("panda_gelsight", "panda_gelsight")]  # noqa: RUF012 (as in ManiSkill)

    def _load_agent(self, options):
        super()._load_agent(options, [sapien.Pose(), sapien.Pose([1, 0, 0], [0, 0, 0, 1])])


def test_all_of_another_robot_of_the_same_kind_is_felt():
    env = TwoRobotsEnv(robot_uids=("panda_gelsight", "panda_gelsight"), control_mode="pd_joint_pos", render_backend="none")
    own, other = (agent.robot for agent in env.agent.agents)
    surfaces = TactileSensor(sensor_config("gelsight_r15", "pad", "gel_right"), env.scene, own)._depth.surfaces
    felt = {robot.name: {s.body.name for s in surfaces if s.body.articulation is robot} for robot in (own, other)}
    assert felt[own.name] == {"panda_leftfinger", "gel_left"}
    assert felt[other.name] >= {"panda_link7", "panda_hand", "panda_rightfinger", "gel_right", "gel_left"}
    env.close()


def test_a_static_body_is_felt_where_an_episode_puts_it():
    def build(env):
        builder = env.scene.create_actor_builder()
        builder.add_box_collision(half_size=[3e-3] * 3)
        builder.initial_pose = sapien.Pose([0, 0, 2])
        return [builder.build_static("post")]

    env = PadBench(build, obs_mode="tacff", render_backend="none")
    sensor = env._tactile_sensors["tactile_right"]
    for depth in (2e-4, 5e-4):
        env.place(env.objects[0], sapien.Pose([0, 0, 3e-3 - depth]))
        sensor._depth.look()
        assert sensor._depth.heights(sensor.model.cells).max().item() == pytest.approx(depth, abs=5e-6)
    env.close()


@pytest.mark.parametrize("turn", [0, 30, 90])
def test_a_small_body_is_seen_anywhere_on_the_face_however_its_own_frame_is_turned(turn):
    cube = trimesh.creation.box([2e-3] * 3)
    body = Rotation.from_euler("z", turn, degrees=True).as_quat()
    rays = MeshRays([[cube]], (0.024, 0.032), torch.device("cpu"))
    for x, y in ((0.0, 0.0), (0.0, 0.0145), (0.0, -0.0145), (0.0105, 0.0), (-0.0105, -0.0145)):
        rays.move(torch.tensor([[[x, y, 1e-3 - 3e-4, *body]]]).float(), torch.tensor([[0.0, 0, 0, 0, 0, 0, 1]]))
        assert rays.heights(torch.tensor([[x, y]])).item() == pytest.approx(3e-4, abs=1e-6)


def test_velocity_is_along_the_surface_of_a_body_that_turns():
    """A plate aslant: v + w x p at the point that a ray meets, without its part along the normal of the plate; pad frame."""
    x = np.array([[0.0, 0.0], [4e-3, 0.0], [0.0, -6e-3], [-3e-3, 5e-3]])
    slope = 0.1  # rad about y
    plate = trimesh.creation.box([0.03, 0.04, 0.01]).apply_translation([0, 0, 5e-3])
    in_pad = sapien.Pose([0, 0, -1e-4], [np.cos(slope / 2), 0, np.sin(slope / 2), 0])
    pad = sapien.Pose([0.3, -0.2, 0.5], [0.5, -0.5, 0.5, 0.5])
    body = pad * in_pad
    rays = MeshRays([[plate]], (0.024, 0.032), torch.device("cpu"))
    rays.move(
        *(
            torch.tensor([*pose.p, *pose.q[[1, 2, 3, 0]]]).float().view(shape)
            for pose, shape in ((body, (1, 1, 7)), (pad, (1, 7)))
        )
    )
    twist = np.array([0.02, -0.01, 0.03, 1.0, -2.0, 3.0])  # m/s, rad/s
    height, velocity = rays.sliding(torch.tensor(x).float(), torch.tensor(twist).float().view(1, 1, 6))
    expected = 1e-4 + x[:, 0] * np.tan(slope)
    assert height[0].numpy() == pytest.approx(expected, abs=1e-6)
    v = twist[:3] + np.cross(twist[3:], np.c_[x, -expected])
    normal = np.array([np.sin(slope), 0, np.cos(slope)])
    assert velocity[0].numpy() == pytest.approx((v - (v @ normal)[:, None] * normal)[:, :2], abs=1e-6)


def test_velocity_counts_from_the_centre_of_mass():
    """A block that turns about a point far from its origin: the engine's velocity is that of its centre of mass."""

    def build(env):
        builder = env.scene.create_actor_builder()
        builder.add_box_collision(half_size=[0.01, 0.01, 5e-3])
        builder.set_mass_and_inertia(0.1, sapien.Pose([0.02, -0.01, 0.03]), [1e-4] * 3)
        builder.initial_pose = sapien.Pose([0, 0, 2])
        return [builder.build("block")]

    env = PadBench(build, obs_mode="tacff", render_backend="none")
    sensor, pad = env._tactile_sensors["tactile_right"], env.agent.gels["right"].pose.sp
    axes = pad.to_transformation_matrix()[:3, :3]
    env.place(env.objects[0], sapien.Pose([0, 0, 5e-3]))
    linear, spin = np.array([0.02, -0.01, 0.0]), np.array([0.5, -1.0, 2.0])  # pad frame
    body = env.objects[0]._bodies[0]
    body.set_linear_velocity(axes @ linear)
    body.set_angular_velocity(axes @ spin)
    sensor._depth.look()
    points = np.array([[0.0, 0.0], [5e-3, -4e-3]])
    _, velocity = sensor._depth.sliding(torch.tensor(points).float())
    centre = np.array([0.02, -0.01, 0.035])
    of_body = linear + np.cross(spin, np.c_[points, np.zeros(2)] - centre)
    assert velocity[0].numpy() == pytest.approx(-of_body[:, :2], abs=1e-4)  # the pad rests
    env.close()


def test_each_of_several_pads_takes_the_twists_of_all_bodies_in_its_own_frame():
    turns = Rotation.from_rotvec([[0.0, 0.0, 0.3], [1.0, 0.0, 0.0]])
    pads = np.concatenate([np.ones((2, 3)), turns.as_quat()[:, [3, 0, 1, 2]]], axis=1)
    twist = np.random.default_rng(0).standard_normal((2, 3, 6))
    seen = in_pad_frames(torch.tensor(twist), torch.tensor(pads))
    for pad in range(2):
        parts = [turns[pad].inv().apply(twist[pad, :, part]) for part in (slice(0, 3), slice(3, 6))]
        assert seen[pad].numpy() == pytest.approx(np.concatenate(parts, axis=1))


@needs_renderer
@pytest.mark.parametrize("render_backend", ["auto", "none"])
def test_what_is_drawn_but_collides_with_nothing_is_not_felt(render_backend):
    """ManiSkill marks goals with such bodies."""

    def build(env):
        builder = env.scene.create_actor_builder()
        if env.scene.can_render():
            builder.add_sphere_visual(radius=0.02, material=RenderMaterial())
        builder.initial_pose = sapien.Pose([0, 0, 2])
        return [builder.build_kinematic("goal_site")]

    env = PadBench(build, obs_mode="tacff", render_backend=render_backend)
    sensor = env._tactile_sensors["tactile_right"]
    env.place(env.objects[0], sapien.Pose([0, 0, 0.02 - DEEP]))
    sensor._depth.look()
    assert sensor._depth.heights(sensor.model.cells).max() < 0
    env.close()


@needs_renderer
@pytest.mark.parametrize("front_drawn", [True, False])
@pytest.mark.parametrize("render_backend", ["auto", "none"])
def test_a_front_that_is_left_out_is_not_felt(render_backend, front_drawn):
    env = PadBench(
        lambda env: [container(front_drawn).build(env.scene, "kinematic", sapien.Pose([0, 0, 2]))],
        obs_mode="tacff",
        render_backend=render_backend,
    )
    sensor = env._tactile_sensors["tactile_right"]
    front_to_pad = sapien.Pose(q=[np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])  # its x is along -z
    (depth, _), middle = CONTAINER_OUTER, CONTAINER_HEIGHT / 2
    env.place(env.objects[0], sapien.Pose([0, 0, depth / 2 - DEEP]) * front_to_pad * sapien.Pose([0, 0, -middle]))
    sensor._depth.look()
    height = sensor._depth.heights(sensor.model.cells)
    assert (height.min() == pytest.approx(DEEP, abs=5e-6)) is front_drawn
    assert (height.max() < 0) is not front_drawn
    env.close()


@needs_renderer
def test_empty_mesh_is_named():
    points = np.eye(3, dtype=np.float32)
    shape = sapien.render.RenderShapeTriangleMesh(
        points, np.zeros((0, 3), np.uint32), points, np.zeros((3, 2), np.float32), RenderMaterial()
    )
    entity, body = sapien.Entity(), sapien.render.RenderBodyComponent()
    body.attach(shape)
    entity.add_component(body)
    entity.name = "nothing"
    with pytest.raises(InvalidFileError, match=r"nothing.*without triangles"):
        entity_mesh(entity)


def test_sapien_backend_without_renderer_says_what_to_do():
    env = PadBench(obs_mode="state", render_backend="none")
    with pytest.raises(MachineError, match="backend='raycast'"):
        TactileSensor(sensor_config("digit", "touch", "gel_right", backend="sapien"), env.scene, env.agent.robot)
    env.close()
