"""Cameras and light of the tasks: where they stand, and what is rendered."""

import numpy as np
import pytest
import sapien
import torch

from manifeel_ms3.errors import InvalidArgumentError
from tests.tasks_and_marks import PEG, needs_renderer


@needs_renderer
def test_render_modes_show_cameras_and_touch(make_env):
    env = make_env(obs_mode="rgb+tacrgb+tacff", render_mode="sensors")
    env.reset(seed=0)
    images = env.unwrapped.get_sensor_images()
    assert set(images["tactile_right"]) == {"rgb", "force_field"}
    assert images["tactile_right"]["force_field"].shape == (1, 240, 320, 3)
    assert env.render().dtype == torch.uint8
    everything = make_env(obs_mode="rgb+tacff", render_mode="all")
    everything.reset(seed=0)
    picture = everything.render()
    assert picture.shape[1] >= 512
    assert picture.shape[2] > 512 + 256


@needs_renderer
def test_without_cameras_and_touch_the_overview_alone_is_rendered(make_env):
    env = make_env(obs_mode="none", cameras=[], tactile_sensors=[], render_mode="all")  # as in recorded files of states
    env.reset(seed=0)
    assert torch.equal(env.render(), env.unwrapped.render_rgb_array())
    with pytest.raises(InvalidArgumentError, match="name some in `cameras`"):
        env.unwrapped.render_sensors()


@needs_renderer
def test_dim_light_is_dim(make_env):
    normal, _ = make_env(obs_mode="rgb").reset(seed=0)
    dim, _ = make_env(obs_mode="rgb", lighting="dim").reset(seed=0)
    ratio = dim["sensor_data"]["wrist"]["rgb"].float().mean() / normal["sensor_data"]["wrist"]["rgb"].float().mean()
    assert ratio < 0.35


@needs_renderer
def test_dim_ball_sorting_is_dim_unless_it_is_asked_to_be_light(make_env):
    levels = {}
    for name, lighting in (("BallSorting", {}), ("BallSortingDim", {}), ("BallSortingDim", dict(lighting="normal"))):
        env = make_env(f"ManiFeel-{name}-v1", obs_mode="rgb", sensor_configs=dict(width=32, height=32), **lighting)
        levels[name, bool(lighting)] = env.reset(seed=0)[0]["sensor_data"]["front"]["rgb"].float().mean().item()
    assert levels["BallSortingDim", False] < 0.35 * levels["BallSorting", False]
    assert levels["BallSortingDim", True] == levels["BallSorting", False]


@needs_renderer
@pytest.mark.parametrize(
    ("task", "front", "side"),
    [
        (PEG, (0.68, 0.0, 0.15), (0.5, -0.17, 0.17)),
        ("ManiFeel-BulbInstallation-v1", (0.68, 0.0, 0.15), (0.5, -0.17, 0.17)),
        *(
            (f"ManiFeel-{name}-v1", (0.80, 0.0, 0.15), (0.5, -0.4, 0.17))
            for name in ("PegReorientation", "ObjectSearch", "BallSorting")
        ),
    ],
)
def test_cameras_stand_where_the_paper_has_them_and_look_30_degrees_down(make_env, task, front, side):
    """Position and view in the base frame, or in the frame of the hand; x ahead and z up in SAPIEN's cameras."""
    slant = np.array([np.cos(np.pi / 6), -np.sin(np.pi / 6)])
    views = {"front": (front, (-slant[0], 0.0, slant[1])), "side": (side, (0.0, *slant))}
    env = make_env(task, obs_mode="rgb", cameras=("front", "side", "wrist"), sensor_configs=dict(width=32, height=32))
    env.reset(seed=0)
    base = env.unwrapped
    views["wrist"] = ((0.045, 0.0, 0.04), (slant[1], 0.0, slant[0]))  # along the fingers, and inward
    frames = {name: sapien.Pose() for name in views} | dict(wrist=base.agent.robot.links_map["panda_hand"].pose.sp)
    focal = 16 / np.tan(np.deg2rad(75) / 2)  # pixels
    for name, (position, ahead) in views.items():
        params = base.get_sensor_params()[name]
        placed = frames[name].inv().to_transformation_matrix() @ params["cam2world_gl"][0].numpy()
        assert placed[:3, 3] == pytest.approx(position, abs=1e-5), name
        assert -placed[:3, 2] == pytest.approx(ahead, abs=1e-5), name  # OpenGL's cameras look along -z, y up
        if name != "wrist":
            assert placed[2, 1] == pytest.approx(slant[0], abs=1e-5), name
        assert params["intrinsic_cv"][0, [0, 1], [0, 1]].tolist() == pytest.approx([focal, focal], rel=1e-5), name
