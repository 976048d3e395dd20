"""Visual randomization: drawn from the seed, told in `info`, and of no influence on what happens."""

import numpy as np
import pytest
import sapien
import torch
from mani_skill.sensors.camera import CameraConfig

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.rendering.shader_pack import camera_shader
from manifeel_ms3.tasks import PegInsertionEnv
from tests.tasks_and_marks import needs_renderer

EVERYTHING = dict(
    light_direction=0.5,
    light_level=0.4,
    part_colour=0.2,
    table_colour=0.3,
    table_texture=2,
    camera_position=0.005,
    camera_rotation=0.05,
)


def look(env, seed: int) -> tuple[np.ndarray, dict]:
    obs, info = env.reset(seed=seed)
    return obs["sensor_data"]["wrist"]["rgb"][0].int().numpy(), info


@pytest.fixture(scope="module")
def env(make_env):
    return make_env(obs_mode="rgb", visual_randomization=EVERYTHING)


@pytest.fixture(scope="module")
def plain(make_env):
    return make_env(obs_mode="rgb")


@needs_renderer
def test_looks_follow_from_the_seed_and_are_told(env):
    first, info = look(env, 1)
    other, other_info = look(env, 2)
    again, same_info = look(env, 1)
    assert np.array_equal(first, again)
    assert np.abs(first - other).mean() > 10
    looks, others = info["looks"], other_info["looks"]
    assert {"light_direction", "light_level", "table_colour", "peg_colour", "socket_colour", "wrist_rotation"} <= set(looks)
    assert all(torch.equal(value, same_info["looks"][name]) and value.shape[0] == 1 for name, value in looks.items())
    assert not torch.equal(looks["peg_colour"], others["peg_colour"])
    assert looks["wrist_position"].abs().max() <= EVERYTHING["camera_position"]
    assert abs(looks["light_level"].item() - 1) <= EVERYTHING["light_level"]


@needs_renderer
def test_an_episode_without_a_seed_is_drawn_around_the_usual_looks(env):
    env.reset(seed=0)
    levels = [env.reset()[1]["looks"]["light_level"].item() for _ in range(6)]
    assert len(set(levels)) == 6
    assert max(abs(level - 1) for level in levels) <= EVERYTHING["light_level"]
    camera = env.unwrapped._sensors["wrist"].camera._render_cameras[0]
    usual = env.unwrapped._random_looks.poses["wrist"].p
    assert np.abs(camera.local_pose.p - usual).max() <= EVERYTHING["camera_position"] * 2  # rotated, not summed up


@needs_renderer
@pytest.mark.parametrize("name", EVERYTHING)
def test_each_kind_changes_the_image_and_leaves_the_state(make_env, env, plain, name):
    alone = make_env(obs_mode="rgb", visual_randomization={name: EVERYTHING[name]})
    changed = np.abs(look(alone, 6)[0] - look(plain, 6)[0]).max(axis=-1)
    assert (changed > 5).mean() > 0.002
    look(alone, 5)
    look(env, 5)
    look(plain, 5)
    assert torch.equal(alone.unwrapped.get_state(), plain.unwrapped.get_state())
    assert torch.equal(env.unwrapped.get_state(), plain.unwrapped.get_state())


class PegFromAboveEnv(PegInsertionEnv):
    """PegInsertion with one more camera."""

    own_cameras = ("above",)

    @property
    def _default_sensor_configs(self):
        if "above" not in self.camera_names:
            return super()._default_sensor_configs
        pose = sapien.Pose([0.5, 0.0, 0.6], [0.7071, 0.0, 0.7071, 0.0])
        above = CameraConfig("above", pose, 32, 32, fov=1.0, near=0.01, far=100, shader_config=camera_shader())
        return [*super()._default_sensor_configs, above]


@needs_renderer
def test_a_camera_that_a_task_adds_is_one_of_its_cameras():
    seen = {}
    for size in (0.0, 0.03):
        env = PegFromAboveEnv(obs_mode="rgb", cameras=("above",), visual_randomization=dict(camera_position=size))
        obs, info = env.reset(seed=5)
        assert set(obs["sensor_data"]) == {"above"}
        seen[size] = obs["sensor_data"]["above"]["rgb"]
        env.close()
    assert info["looks"]["above_position"].abs().max() > 0.001
    assert not torch.equal(*seen.values())
    env = PegFromAboveEnv(obs_mode="rgb")
    assert set(env.reset(seed=5)[0]["sensor_data"]) == {"wrist"}  # it costs nothing where nobody asks for it
    env.close()
    with pytest.raises(InvalidArgumentError, match="camera 'above' draw no albedo"):
        PegFromAboveEnv(obs_mode="rgb+albedo", cameras=("above",))


@needs_renderer
def test_usual_looks_are_not_told(plain):
    assert "looks" not in look(plain, 5)[1]


def test_an_unknown_or_impossible_look_is_refused(make_env):
    with pytest.raises(InvalidArgumentError, match=r"visual_randomization\['fog'\] is unknown.*'light_level'"):
        make_env(obs_mode="none", render_backend="none", visual_randomization=dict(fog=1.0))
    with pytest.raises(InvalidArgumentError, match=r"too large, at most 0\.9"):
        make_env(obs_mode="none", render_backend="none", visual_randomization=dict(light_level=2.0))
    with pytest.raises(InvalidArgumentError, match="finite number"):
        make_env(obs_mode="none", render_backend="none", visual_randomization=dict(light_level=-0.1))
    with pytest.raises(InvalidArgumentError, match=r"\['table_texture'\]=2\.5 must be a whole number"):
        make_env(obs_mode="none", render_backend="none", visual_randomization=dict(table_texture=2.5))


@needs_renderer
def test_the_occluder_hides_where_the_battery_is(make_env):
    """The room's light, shadow and reflections let nothing out of the container."""
    env = make_env("ManiFeel-ObjectSearch-v1", obs_mode="rgb", cameras=("front",), randomization=dict(place_xy=0.0))
    images = {}
    for seed in range(8):
        obs, _ = env.reset(seed=seed)
        images.setdefault(int(env.unwrapped.place[0]), obs["sensor_data"]["front"]["rgb"])
    assert len(images) == 2
    assert torch.equal(images[0], images[1])
