"""Both depth backends against closed forms, and against each other."""

import numpy as np
import pytest
import sapien
import torch
import trimesh
from sapien.render import RenderMaterial

from manifeel_ms3.sensors import TactileSensor, gelsight_r15
from manifeel_ms3.sensors.raycast import REACH
from tests.conftest import needs_renderer
from tests.sensors.bench import PadBench

RADIUS = 0.008
DEEP = 5e-4  # m into the gel


@pytest.fixture(scope="module")
def ball_env(tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "ball.obj"
    trimesh.creation.icosphere(subdivisions=6, radius=RADIUS).export(path)

    def build(env):
        builder = env.scene.create_actor_builder()
        builder.add_sphere_collision(radius=RADIUS)
        builder.add_visual_from_file(str(path), material=RenderMaterial(base_color=[1, 0, 0, 1]))
        builder.initial_pose = sapien.Pose([0, 0, 2])
        return [builder.build_kinematic("ball")]

    env = PadBench(build, obs_mode="rgb", cameras=("wrist",))
    yield env
    env.close()


def heights(env: PadBench, backend: str) -> tuple[torch.Tensor, torch.Tensor]:
    sensor = TactileSensor(gelsight_r15("tactile", "gel_right", backend=backend), env.scene, env.agent.robot)
    env.scene.update_render()
    sensor._depth.look()
    return sensor._depth.heights(sensor.model.pixels)[0], sensor.model.pixels


def cap(pixels: torch.Tensor, x: float, y: float) -> torch.Tensor:
    """Height of the ball that sits DEEP in the gel at (x, y), as far as its flanks are shallow."""
    r2 = (pixels[:, 0] - x) ** 2 + (pixels[:, 1] - y) ** 2
    return (RADIUS**2 - r2).clamp(min=0).sqrt() - RADIUS + DEEP


@needs_renderer
@pytest.mark.parametrize("backend", ["raycast", "sapien"])
@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (5e-3, -9e-3), (-6e-3, 8e-3)])
def test_ball_is_seen_within_five_micrometres(ball_env, backend, x, y):
    ball_env.place(ball_env.objects[0], sapien.Pose([x, y, RADIUS - DEEP]))
    seen, pixels = heights(ball_env, backend)
    expected = cap(pixels, x, y)
    near = expected > -2e-3
    error = (seen - expected)[near]
    assert error.square().mean().sqrt() < 5e-6
    assert seen[expected <= -RADIUS + DEEP].max() <= -REACH + 1e-4  # and nothing is seen beside it


@needs_renderer
def test_backends_agree_within_five_micrometres(ball_env):
    ball_env.place(ball_env.objects[0], sapien.Pose([1e-3, 2e-3, RADIUS - DEEP]))
    rays, pixels = heights(ball_env, "raycast")
    camera, _ = heights(ball_env, "sapien")
    near = cap(pixels, 1e-3, 2e-3) > -2e-3
    assert (rays - camera)[near].square().mean().sqrt() < 5e-6


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


def test_sapien_backend_without_renderer_says_what_to_do():
    env = PadBench(obs_mode="state", render_backend="none")
    with pytest.raises(RuntimeError, match="backend='raycast'"):
        TactileSensor(gelsight_r15("touch", "gel_right", backend="sapien"), env.scene, env.agent.robot)
    env.close()
