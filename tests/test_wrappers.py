"""ManiSkill's wrappers, vector environments and recorder run on our ids with touch."""

import numpy as np
import pytest
import torch
from mani_skill.utils.wrappers import CPUGymWrapper, FlattenRGBDObservationWrapper, FrameStack
from mani_skill.utils.wrappers.flatten import FlattenObservationWrapper
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.wrappers import FlattenVisuotactileObservationWrapper, PadsAsCamerasWrapper, resized
from tests.tasks_and_marks import needs_renderer

SMALL = dict(sensor_configs=dict(width=64, height=64))
TOUCH = dict(obs_mode="state+tacff", render_backend="none")


@needs_renderer
def test_each_modality_is_an_entry(make_env):
    env = make_env(obs_mode="rgb+depth+tacrgb+tacff", cameras=("front", "wrist"), tactile_sensors=("left", "right"), **SMALL)
    raw, _ = env.reset(seed=0)
    flat = FlattenVisuotactileObservationWrapper(env)
    obs, _ = flat.reset(seed=0)
    shapes = {name: tuple(space.shape) for name, space in flat.observation_space.spaces.items()}
    assert shapes == {name: tuple(data.shape) for name, data in obs.items()}
    assert shapes == dict(
        state=(1, 25), rgb=(1, 64, 64, 6), depth=(1, 64, 64, 2), tacrgb=(1, 240, 320, 6), tacff=(1, 10, 14, 6)
    )
    touch = raw["sensor_data"]["tactile_right"]
    assert torch.equal(obs["tacff"][..., 3:], touch["force_field"])
    assert torch.equal(obs["tacrgb"][..., 3:], touch["rgb"])
    assert torch.equal(obs["rgb"][..., :3], raw["sensor_data"]["front"]["rgb"])
    assert torch.equal(obs["state"][:, -7:], raw["extra"]["tcp_pose"])


@needs_renderer
def test_images_are_resized_and_joined_for_scripts_that_know_cameras_alone(make_env):
    env = make_env(obs_mode="rgb+tacrgb", **SMALL)
    with pytest.raises(InvalidArgumentError, match=r"\(64, 64\), \(240, 320\).*image_size"):
        FlattenVisuotactileObservationWrapper(env, sep_tacrgb=False)
    obs, _ = FlattenVisuotactileObservationWrapper(env, state=False, sep_tacrgb=False, image_size=48).reset(seed=0)
    assert set(obs) == {"rgb"}
    assert (obs["rgb"].shape, obs["rgb"].dtype) == ((1, 48, 48, 6), torch.uint8)
    tacrgb = env.unwrapped.get_obs()["sensor_data"]["tactile_right"]["rgb"].float()
    assert obs["rgb"][..., 3:].float().mean((1, 2)) == pytest.approx(tacrgb.mean((1, 2)), abs=1.0)


@pytest.mark.parametrize("left_out", [("tacrgb", "depth"), ("tacff", "rgb"), ("state",)])
def test_what_is_not_asked_for_is_left_out(make_env, left_out):
    wrapper = FlattenVisuotactileObservationWrapper(make_env(**TOUCH), **dict.fromkeys(left_out, False))
    image, field = torch.zeros(1, 4, 4, 3), torch.zeros(1, 10, 14, 3)
    sensors = dict(wrist=dict(rgb=image, depth=image[..., :1]), tactile_right=dict(rgb=image, force_field=field))
    obs = wrapper.observation(dict(sensor_data=sensors, extra=dict(tcp_pose=torch.zeros(1, 7))))
    assert set(obs) == {"state", "rgb", "depth", "tacrgb", "tacff"} - set(left_out)


def test_a_smaller_image_is_what_it_was_side_up():
    image = torch.arange(4 * 6 * 3, dtype=torch.uint8).view(4, 6, 3)
    large = image.repeat_interleave(10, dim=0).repeat_interleave(10, dim=1)[None]
    small = resized(large, (4, 6))
    assert small.dtype == torch.uint8
    assert (small[0, 1:3, 1:5].int() - image[1:3, 1:5].int()).abs().max() <= 1  # the filter reaches into the neighbours
    assert torch.equal(resized(image[None], (4, 6)), image[None])
    square = resized(large[:, :, :40], (4, 4))[0].int()
    assert (square[1:3, 1:3] - image[1:3, 1:3].int()).abs().max() <= 1


def test_touch_joins_the_state_in_one_vector(make_env):
    env = make_env(**TOUCH)
    raw, _ = env.reset(seed=0)
    expected = torch.cat([raw["state"], raw["sensor_data"]["tactile_right"]["force_field"].flatten(1)], dim=1)
    stock = FlattenObservationWrapper(FlattenVisuotactileObservationWrapper(env, flat_tacff=True))
    assert torch.equal(stock.reset(seed=0)[0], expected)
    pads = FlattenObservationWrapper(PadsAsCamerasWrapper(make_env(**TOUCH)))
    assert torch.equal(pads.reset(seed=0)[0], expected)
    assert pads.observation_space.shape == (1, expected.shape[1])


@needs_renderer
@pytest.mark.parametrize("mode", ["rgb+tacff", "rgb+tacrgb", "rgb+depth+tacff", "rgb+tacrgb+tacff", "depth+tacff"])
def test_maniskills_flattening_runs_over_touch(make_env, mode):
    env = FlattenRGBDObservationWrapper(PadsAsCamerasWrapper(make_env(obs_mode=mode, **SMALL)))
    obs, _ = env.reset(seed=0)
    images = set(mode.split("+")) & {"rgb", "depth"}
    assert set(obs) == {"state"} | images
    assert "rgb" not in obs or obs["rgb"].shape[-1] == (6 if "tacrgb" in mode else 3)
    assert obs["state"].shape[1] == 25 + (420 if "tacff" in mode else 0)
    stacked, _ = FrameStack(env, num_stack=2).reset(seed=0)
    assert all(stacked[image].shape == (1, 2, *obs[image].shape[1:]) for image in images)


@needs_renderer
def test_pads_have_no_depth(make_env):
    with pytest.raises(InvalidArgumentError, match="leave 'tacrgb' out"):
        PadsAsCamerasWrapper(make_env(obs_mode="rgb+depth+tacrgb", **SMALL))


def test_a_mode_without_sensors_is_refused(make_env):
    with pytest.raises(InvalidArgumentError, match="this environment has obs_mode='state'"):
        FlattenVisuotactileObservationWrapper(make_env(obs_mode="state", render_backend="none"))


@needs_renderer
def test_a_pointcloud_is_refused(make_env):
    with pytest.raises(InvalidArgumentError, match=r"pointcloud cannot be flattened.*'rgb\+depth'"):
        FlattenVisuotactileObservationWrapper(make_env(obs_mode="pointcloud+tacff", **SMALL))


def test_cpu_gym_wrapper_gives_numpy_without_a_batch(make_env):
    env = CPUGymWrapper(FlattenVisuotactileObservationWrapper(make_env(**TOUCH)), ignore_terminations=True, record_metrics=True)
    env.reset(seed=0)
    obs, reward, *_, info = env.step(env.action_space.sample())
    assert (obs["tacff"].shape, obs["state"].ndim) == ((10, 14, 3), 1)
    assert np.ndim(reward) == 0
    assert {"return", "success_once", "success_at_end"} <= set(info["episode"])
    assert env.observation_space.contains(obs)


def test_vector_env_begins_anew_at_the_time_limit(make_env):
    env = FlattenVisuotactileObservationWrapper(make_env(max_episode_steps=2, **TOUCH))
    envs = ManiSkillVectorEnv(env, ignore_terminations=True, record_metrics=True)
    envs.reset(seed=0)
    for _ in range(2):
        obs, *_, infos = envs.step(envs.action_space.sample())
    assert infos["final_info"]["episode"]["episode_len"] == 2
    assert obs["tacff"].shape == infos["final_observation"]["tacff"].shape == (1, 10, 14, 3)
