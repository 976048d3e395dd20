"""The contract of every task's environment: what is observed, and what is refused."""

import os
import subprocess
import sys

import pytest
import torch
from mani_skill.utils.structs import Pose

from manifeel_ms3.arguments import checked_action
from manifeel_ms3.errors import InvalidArgumentError, MachineError
from manifeel_ms3.rendering.backend import NO_RENDERER
from manifeel_ms3.tasks import registry, visuotactile_env
from manifeel_ms3.tasks.checks import check_base_arguments, check_renderer
from manifeel_ms3.tasks.insertion.peg_insertion import PegInsertionEnv
from manifeel_ms3.tasks.obs_modes import split_obs_mode
from manifeel_ms3.tasks.screwing.bulb_installation import BulbInstallationEnv
from tests.tasks_and_marks import needs_renderer


@needs_renderer
def test_observation_keys_shapes_and_types(make_env):
    env = make_env(obs_mode="rgb+tacrgb+tacff", cameras=("front", "side", "wrist"), tactile_sensors=("left", "right"))
    obs, _ = env.reset(seed=0)
    data = obs["sensor_data"]
    assert set(data) == {"front", "side", "wrist", "tactile_left", "tactile_right"}
    for camera in ("front", "side", "wrist"):
        assert data[camera]["rgb"].shape == (1, 256, 256, 3)
        assert data[camera]["rgb"].dtype == torch.uint8
        assert data[camera]["rgb"].float().std() > 5  # a picture, not a blank
    for side in ("left", "right"):
        touch = data[f"tactile_{side}"]
        assert touch["rgb"].shape == (1, 240, 320, 3)
        assert touch["rgb"].dtype == torch.uint8
        assert touch["force_field"].shape == (1, 10, 14, 3)
        assert touch["force_field"].dtype == torch.float32
        assert touch["penetration"].shape == (1, 10, 14)
    assert obs["extra"]["tcp_pose"].shape == (1, 7)
    assert env.observation_space.contains({k: _numpy(v) for k, v in obs.items()})


def _numpy(tree):
    return {k: _numpy(v) for k, v in tree.items()} if isinstance(tree, dict) else tree.cpu().numpy()


def leaves(tree, prefix=""):
    for key, value in tree.items():
        yield from leaves(value, f"{prefix}{key}/") if isinstance(value, dict) else [f"{prefix}{key}"]


@needs_renderer
@pytest.mark.parametrize("mode", ["rgb", "rgb+tacrgb", "rgb+tacff", "tacff+rgb", "tacff", "tacrgb+tacff", "rgb+depth+tacff"])
def test_visual_modes_hold_nothing_privileged(make_env, mode):
    obs, _ = make_env(obs_mode=mode).reset(seed=0)
    known = {"agent/qpos", "agent/qvel", "extra/tcp_pose"}
    rest = {leaf for leaf in leaves(obs) if not leaf.startswith(("sensor_data/", "sensor_param/"))}
    assert rest == known
    assert any("force_field" in leaf for leaf in leaves(obs)) == ("tacff" in mode)
    assert any("tactile_right/rgb" in leaf for leaf in leaves(obs)) == ("tacrgb" in mode)
    assert any("wrist/rgb" in leaf for leaf in leaves(obs)) == ("rgb" in mode.split("+"))


@needs_renderer
@pytest.mark.parametrize("occlusion", [True, False])
def test_visual_observation_depends_on_a_hidden_part_only_without_the_occluder(make_env, occlusion):
    """Same robot, another place of the rim in the box: behind the occluder the observation is the same to the bit."""
    env = make_env("ManiFeel-PegReorientation-v1", obs_mode="rgb", occlusion=occlusion)
    obs, _ = env.reset(seed=0)
    pose = env.unwrapped.socket.pose.raw_pose.clone()
    pose[:, :2] += 0.03
    env.unwrapped.socket.set_pose(Pose.create(pose))
    moved = env.unwrapped.get_obs()
    for group in ("agent", "extra"):
        for name, value in obs[group].items():
            assert torch.equal(value, moved[group][name])
    same = torch.equal(obs["sensor_data"]["front"]["rgb"], moved["sensor_data"]["front"]["rgb"])
    assert same is occlusion


def test_state_modes(make_env):
    state, _ = make_env(obs_mode="state", render_backend="none").reset(seed=0)
    assert isinstance(state, torch.Tensor)
    tree, _ = make_env(obs_mode="state_dict", render_backend="none").reset(seed=0)
    assert {"plug_pose", "socket_pose", "tcp_pose"} <= set(tree["extra"])
    both, _ = make_env(obs_mode="state+tacff", render_backend="none").reset(seed=0)
    assert torch.equal(both["state"], state)
    assert both["sensor_data"]["tactile_right"]["force_field"].abs().max() > 0


@pytest.mark.parametrize(
    ("mode", "word"),
    [
        ("rgb+touch", "tacff"),
        ("rgb+rgb", "more than once"),
        ("pointcloud+rgb", "cannot be joined"),
        ("", "unknown"),
        ("state+state_dict", "two forms"),
    ],
)
def test_bad_obs_modes_name_what_is_known(mode, word):
    with pytest.raises(ValueError, match=word):
        split_obs_mode(mode)


@needs_renderer
def test_images_without_a_camera_are_missing_with_a_warning(make_env, caplog):
    env = make_env(obs_mode="rgb", cameras=())
    assert "observes images, but cameras names no camera" in caplog.text
    assert not env.reset(seed=0)[0]["sensor_data"]


def test_touch_without_a_pad_is_missing_with_a_warning(make_env, caplog):
    env = make_env(obs_mode="tacff", tactile_sensors=(), render_backend="none")
    assert "observes touch, but tactile_sensors names no pad" in caplog.text
    assert not env.reset(seed=0)[0]["sensor_data"]


@pytest.mark.parametrize(
    ("kwargs", "word"),
    [
        (dict(obs_mode="rgb+smell"), "tacrgb"),
        (dict(cameras=("top",)), "wrist"),
        (dict(tactile_sensors=("middle",)), "left"),
        (dict(lighting="disco"), "dim"),
        (dict(tactile={"optics.nose": 1.0}), "optics.nose"),
        (dict(tactile={"gel.thickness": 0.0}), "gel.thickness"),
        (dict(sensor_configs=dict(tactile_left=dict(units="tacsl"))), r"neither a sensor.*'wrist', 'tactile_right'"),
        (dict(sensor_configs=dict(tactile_right=dict(optics=dict(nose=1.0)))), "optics.nose"),
        (dict(sensor_configs=dict(wrist=dict(widht=64))), "'widht'. are not fields of a camera; choose from"),
        (dict(sensor_configs=dict(wrist=dict(shader_pack="fast"))), r"'wrist'.*shader_pack.*'fast' is unknown.*'default'"),
        (dict(sensor_configs=dict(shader_pack="fast")), r"sensor_configs\['shader_pack'\]='fast' is unknown.*'default'"),
        (dict(occlusion=True), "nothing that could occlude"),
        (dict(hold_seconds=-1), "hold_seconds=-1 must be a number of at least 0"),
        (dict(hold_seconds="2 s"), "hold_seconds=2 s must be a number"),
        (dict(fit="snug"), "tight"),
        (dict(randomisation={}), r"no arguments \['randomisation'\]; choose from .*'fit'.*'randomization'.*'reward_mode'"),
        (dict(randomization=dict(colour=1.0)), "socket_xy"),
        (dict(randomization=dict(socket_xy=-1.0)), "socket_xy"),
        (dict(randomization=dict(socket_xy=float("nan"))), "finite"),
        (dict(control_mode="pd_ee_delta_pos"), r"control_mode='pd_ee_delta_pos' is unknown.*'pd_ee_delta_pose'"),
        (dict(reward_mode="dens"), r"reward_mode='dens' is unknown.*'normalized_dense'"),
        (dict(render_mode="rgb"), r"render_mode='rgb' is unknown.*'rgb_array'"),
        (dict(render_backend="vulkan"), r"render_backend='vulkan' is unknown.*'cpu'"),
        (dict(sim_backend="mujoco"), r"sim_backend='mujoco' is unknown.*'physx_cpu'"),
        (dict(sim_backend=None), "sim_backend=None is unknown"),
    ],
)
def test_bad_arguments_name_what_is_allowed(make_env, kwargs, word):
    with pytest.raises(ValueError, match=word):
        make_env(**dict(render_backend="none") | kwargs)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
@pytest.mark.parametrize("backend", ["gpu", "physx_cuda", "cuda:1"])
def test_a_simulation_on_a_gpu_that_is_missing_says_so(make_env, backend):
    with pytest.raises(MachineError, match=f"sim_backend='{backend}' needs a CUDA GPU"):
        make_env(sim_backend=backend, render_backend="none")


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(reward_mode="kind"),
        dict(control_mode="telepathy"),
        dict(max_episode_steps=0),
        dict(sim_config=5),
        dict(sim_config=dict(control_freq=0)),
        dict(id="ManiFeel-Knitting-v1"),
        dict(env_id="ManiFeel-Knitting-v1"),
    ],
    ids=str,
)
def test_arguments_that_only_maniskill_refuses_are_an_error_of_one_kind(kwargs):
    """They come from files of strangers, too, whose commands must end without a traceback."""
    with pytest.raises(InvalidArgumentError, match=next(iter(kwargs))):
        registry.make_env("ManiFeel-PegInsertion-v1", obs_mode="none", render_backend="none", **kwargs)


@needs_renderer
@pytest.mark.parametrize("mode", ["normal+tacff", "rgb+albedo"])
def test_textures_that_the_shaders_do_not_draw_are_refused(make_env, mode):
    with pytest.raises(InvalidArgumentError, match=r"draw no (normal|albedo), only .*'rgb'.*shader_pack='default'"):
        make_env(obs_mode=mode)
    small = dict(shader_pack="default", width=16, height=16)
    observation, _ = make_env(obs_mode=mode, sensor_configs=small).reset(seed=0)
    assert set(mode.split("+")) <= {*observation["sensor_data"]["wrist"], "tacff"}


def test_images_without_a_renderer_say_what_to_install(make_env, monkeypatch):
    monkeypatch.setattr(visuotactile_env, "available_render_backend", lambda _asked: "none")
    assert "mesa-vulkan-drivers" in NO_RENDERER
    with pytest.raises(RuntimeError, match="mesa-vulkan-drivers"):
        make_env(obs_mode="rgb")
    with pytest.raises(RuntimeError, match="render_mode"):
        make_env(obs_mode="state", render_mode="rgb_array")


def test_images_from_a_renderer_that_was_declined_are_refused(make_env):
    with pytest.raises(InvalidArgumentError, match="render_backend='none' draws nothing, and obs_mode='rgb' needs images"):
        make_env(obs_mode="rgb", render_backend="none")


@pytest.mark.parametrize("on_gpu", [dict(sim_backend="physx_cuda"), dict(sim_backend="gpu:1"), dict(num_envs=2)])
def test_a_renderer_on_the_cpu_is_refused_for_images_of_what_a_gpu_simulates(on_gpu):
    with pytest.raises(
        MachineError, match=r"obs_mode='rgb' needs images of a simulation on a GPU.* the renderer is on the CPU"
    ):
        check_renderer("cpu", "auto", "rgb", on_gpu)
    check_renderer("cpu", "auto", "state", on_gpu)  # no images
    check_renderer("cuda:1", "auto", "rgb", on_gpu)
    check_renderer("cpu", "auto", "rgb", dict(sim_backend="auto", num_envs=1))


def test_a_task_whose_contacts_do_not_exist_on_a_gpu_warns_there(monkeypatch, caplog):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for task, warns in ((BulbInstallationEnv, True), (PegInsertionEnv, False)):
        check_base_arguments(task, "auto", dict(num_envs=2))
        assert (f"{task.__name__} may not be playable on a GPU" in caplog.text) == warns


def test_machine_without_vulkan_runs_what_needs_no_picture():
    """In a process of its own, which finds no Vulkan driver."""
    script = """
import gymnasium as gym, manifeel_ms3
env = gym.make("ManiFeel-PegInsertion-v1", obs_mode="state")
env.reset(seed=0)
env.step(env.action_space.sample())
obs, _ = gym.make("ManiFeel-PegInsertion-v1", obs_mode="tacrgb+tacff").reset(seed=0)
assert obs["sensor_data"]["tactile_right"]["force_field"].abs().max() > 0
for asked in ("auto", "cpu"):
    try:
        gym.make("ManiFeel-PegInsertion-v1", obs_mode="rgb", render_backend=asked)
    except RuntimeError as error:
        assert "mesa-vulkan-drivers" in str(error)
    else:
        raise SystemExit(f"render_backend={asked!r} raised nothing")
gym.make("ManiFeel-PegInsertion-v1", obs_mode="state")  # what was asked for before is not taken for what works
print("as promised")
"""
    nowhere = {"VK_ICD_FILENAMES": "/nowhere.json", "VK_DRIVER_FILES": "/nowhere.json", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=os.environ | nowhere, check=False)
    assert "as promised" in done.stdout, done.stderr[-2000:]


@needs_renderer
def test_a_pointcloud_can_be_joined_with_touch(make_env, capsys):
    env = make_env(obs_mode="pointcloud+tacff", sensor_configs=dict(width=32, height=32))
    obs, _ = env.reset(seed=0)
    assert obs["pointcloud"]["xyzw"].shape == (1, 32 * 32, 4)
    assert obs["sensor_data"]["tactile_right"]["force_field"].shape == (1, 10, 14, 3)
    env.unwrapped.print_sim_details()
    said = capsys.readouterr().out
    assert "RGBD(32x32)" in said
    assert "tactile_right: TacFF 10 x 14 taxels" in said


def test_an_action_is_copied_when_it_is_checked():
    """A policy may write its next action into the same memory."""
    action = torch.zeros(6)
    checked = checked_action(action, [(6,)])
    action += 1
    assert checked.abs().sum() == 0
