"""What the cameras show: the room, the light, the surfaces, and the same depth and ids as with ManiSkill's shaders."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.rendering.presentation import drawn_sizes
from manifeel_ms3.rendering.shader_pack import SHADER_PACK
from manifeel_ms3.rendering.table import PIXELS, boards, table_mesh
from manifeel_ms3.sensors.depth.surfaces import scene_surfaces
from manifeel_ms3.tasks.registry import all_tasks, task_spec
from tests.tasks_and_marks import PEG, needs_renderer

GROUND = ("table", "floor")


def images(env, camera: str = "wrist", seed: int = 0) -> dict[str, np.ndarray]:
    obs, _ = env.reset(seed=seed)
    return {name: image[0].numpy() for name, image in obs["sensor_data"][camera].items()}


@pytest.fixture(scope="module")
def seen(make_env) -> dict[str, np.ndarray]:
    env = make_env(obs_mode="rgb+depth+segmentation", cameras=("front",))
    return images(env, "front")


@needs_renderer
def test_depth_and_ids_are_those_of_maniskills_shaders(make_env, seen):
    stock = make_env(obs_mode="rgb+depth+segmentation", cameras=("front",), sensor_configs=dict(shader_pack="minimal"))
    stock = images(stock, "front")
    assert np.array_equal(seen["segmentation"], stock["segmentation"])
    assert np.abs(seen["depth"].astype(int) - stock["depth"]).max() <= 1  # mm
    assert (seen["depth"] == stock["depth"]).mean() > 0.999
    assert {name: (image.dtype, image.shape) for name, image in seen.items()} == {
        name: (image.dtype, image.shape) for name, image in stock.items()
    }


@needs_renderer
def test_the_room_is_light_and_has_no_body(make_env, seen):
    nothing = seen["segmentation"][..., 0] == 0
    assert nothing.mean() > 0.1
    assert seen["rgb"][nothing].mean() > 100
    env = make_env(obs_mode="rgb+tacff")
    env.reset(seed=0)
    touchable = {surface.body.name for surface in scene_surfaces(env.unwrapped.scene, set())}
    links = {link.name for link in env.unwrapped.agent.robot.links}
    assert touchable - links == {*GROUND, "peg", "socket"}


@needs_renderer
def test_an_image_for_people_is_large_and_changes_no_policys_image(make_env):
    env = make_env(obs_mode="rgb", render_mode="rgb_array")
    before = images(env)["rgb"]
    picture = env.render()
    assert picture.shape == (1, 768, 768, 3)
    assert picture.dtype == torch.uint8
    assert np.array_equal(env.unwrapped.get_obs()["sensor_data"]["wrist"]["rgb"][0].numpy(), before)
    small = make_env(obs_mode="none", render_mode="rgb_array", human_render_camera_configs=dict(width=200, height=100))
    small.reset(seed=0)
    assert small.render().shape == (1, 100, 200, 3)


@needs_renderer
def test_an_image_for_people_has_a_fine_shadow_whatever_that_of_the_policys_images(make_env):
    pictures, of_policy = {}, {}
    for quality in ("normal", "fast"):
        env = make_env(obs_mode="rgb", cameras=("front",), render_mode="rgb_array", quality=quality)
        of_policy[quality] = images(env, "front")["rgb"].astype(int)
        pictures[quality] = env.render()
        after = env.unwrapped.get_obs()["sensor_data"]["front"]["rgb"][0].numpy()
        assert np.array_equal(after, of_policy[quality])
    assert np.abs(of_policy["normal"] - of_policy["fast"]).max() > 50  # a shadow, and none
    assert torch.equal(pictures["normal"], pictures["fast"])
    env.unwrapped._lamps = []
    assert (env.render().int() - pictures["fast"].int()).abs().max() > 50


@needs_renderer
def test_cameras_with_other_shaders_leave_the_images_of_the_rest_as_they_are(make_env):
    small = dict(width=32, height=32)
    options = dict(obs_mode="rgb", cameras=("front", "wrist"), render_mode="rgb_array", human_render_camera_configs=small)
    usual = make_env(**options, sensor_configs=small)
    mixed = make_env(**options, sensor_configs=small | dict(front=dict(shader_pack="default")))
    wrist = images(usual)["rgb"]
    seen = images(mixed)["rgb"]
    assert seen.dtype == np.uint8
    assert np.array_equal(seen, wrist)
    assert torch.equal(mixed.render(), usual.render())


def test_sizes_of_images_for_people_are_doubled_to_draw_them():
    by_name = dict(render_camera=dict(width=100, fov=1.0))
    assert drawn_sizes(by_name) == dict(render_camera=dict(width=200, fov=1.0))
    assert drawn_sizes(dict(shader_pack="rt")) == dict(shader_pack="rt", width=768, height=768)


@needs_renderer
def test_the_shadow_darkens_and_is_left_out_where_images_are_to_be_fast(make_env, seen):
    fast = images(make_env(obs_mode="rgb+depth+segmentation", cameras=("front",), quality="fast"), "front")
    assert np.array_equal(fast["segmentation"], seen["segmentation"])
    darker = fast["rgb"].astype(int).sum(-1) - seen["rgb"].astype(int).sum(-1)
    assert (darker > 60).mean() > 0.02
    assert (darker < -15).mean() < 0.001  # but for smoothed edges
    with pytest.raises(InvalidArgumentError, match=r"quality='best'.*'normal', 'fast'"):
        make_env(quality="best")


def contrasts(env, camera: str, seed: int = 0) -> dict[str, float]:
    """Median distance in CIELAB, over the outline of each part, between it and what is seen beside it."""
    seen = images(env, camera, seed)
    lab = cv2.cvtColor((seen["rgb"] / 255).astype(np.float32), cv2.COLOR_RGB2LAB)
    square, out = np.ones((3, 3), np.uint8), {}
    parts = {actor.name for actor in env.unwrapped.scene.actors.values()} - set(GROUND)
    for number, body in env.unwrapped.segmentation_id_map.items():
        mask = (seen["segmentation"][..., 0] == number).astype(np.uint8)
        if body.name not in parts or mask.sum() < 30:  # hidden, or out of sight
            continue
        inner = mask - cv2.erode(mask, square, iterations=3)
        outer = (cv2.dilate(mask, square, iterations=4) - cv2.dilate(mask, square)).astype(np.float32)
        weight = cv2.boxFilter(outer, -1, (11, 11), normalize=False)
        beside = cv2.boxFilter(lab * outer[..., None], -1, (11, 11), normalize=False)
        outline = (inner > 0) & (weight > 0)
        distance = np.linalg.norm(lab[outline] - beside[outline] / weight[outline][:, None], axis=1)
        out[body.name] = float(np.median(distance))
    return out


@needs_renderer
@pytest.mark.parametrize("task", [PEG, *(pytest.param(t, marks=pytest.mark.slow) for t in all_tasks() if t != PEG)])
def test_every_part_in_sight_can_be_told_from_what_is_beside_it(make_env, figure, task):
    camera = task_spec(task).policy_camera
    env = make_env(task, obs_mode="rgb+segmentation", cameras=(camera,), lighting="normal")
    found = contrasts(env, camera)
    assert found
    figure("contrast of a part to its surroundings, CIELAB", min(found.values()), at_least=14)


def test_the_tables_texture_continues_on_the_opposite_side():
    image = boards(0).astype(int)
    assert image.shape == (PIXELS, PIXELS, 3)
    along = np.abs(np.diff(image, axis=1)).mean()
    assert np.abs(image[:, 0] - image[:, -1]).mean() < 2 * along  # the grain runs on


def test_the_tables_mesh_is_the_box_that_collides():
    mesh = trimesh.load(table_mesh((1.6, 1.6, 0.04)), force="mesh")
    assert mesh.extents == pytest.approx([1.6, 1.6, 0.04])
    assert mesh.volume == pytest.approx(1.6 * 1.6 * 0.04)  # and its triangles look outwards


def test_the_shaders_declare_no_table_that_sapien_would_compute_before_the_first_image():
    """On a CPU that takes 10 s in each process."""
    assert [path.name for path in Path(SHADER_PACK).iterdir() if "sampler2D samplerBRDFLUT" in path.read_text()] == []
