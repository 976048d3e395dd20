"""The contract of every task's environment: what is observed, what is refused, what is reproducible."""

import os
import subprocess
import sys

import numpy as np
import pytest
import sapien
import torch
from mani_skill.utils.structs import Pose

from manifeel_ms3.arguments import checked_action
from manifeel_ms3.errors import InvalidArgumentError, MachineError
from manifeel_ms3.rendering.backend import NO_RENDERER
from manifeel_ms3.sensors import TactileSensor
from manifeel_ms3.tasks import registry, visuotactile_env
from manifeel_ms3.tasks.obs_modes import split_obs_mode
from manifeel_ms3.tasks.states import is_part_of
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
    [("rgb+touch", "tacff"), ("rgb+rgb", "more than once"), ("pointcloud+rgb", "cannot be joined"), ("", "unknown")],
)
def test_bad_obs_modes_name_what_is_known(mode, word):
    with pytest.raises(ValueError, match=word):
        split_obs_mode(mode)


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


def test_machine_without_vulkan_runs_what_needs_no_picture():
    """In a process of its own, which finds no Vulkan driver."""
    script = """
import gymnasium as gym, manifeel_ms3
env = gym.make("ManiFeel-PegInsertion-v1", obs_mode="state")
env.reset(seed=0)
env.step(env.action_space.sample())
obs, _ = gym.make("ManiFeel-PegInsertion-v1", obs_mode="tacrgb+tacff").reset(seed=0)
assert obs["sensor_data"]["tactile_right"]["force_field"].abs().max() > 0
try:
    gym.make("ManiFeel-PegInsertion-v1", obs_mode="rgb")
except RuntimeError as error:
    assert "mesa-vulkan-drivers" in str(error)
    print("as promised")
"""
    nowhere = {"VK_ICD_FILENAMES": "/nowhere.json", "VK_DRIVER_FILES": "/nowhere.json", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=os.environ | nowhere, check=False)
    assert "as promised" in done.stdout, done.stderr[-2000:]


def rollout(env, seed, steps=6):
    obs, _ = env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    out = [obs["sensor_data"]["tactile_right"]]
    for _ in range(steps):
        obs, *_ = env.step(rng.uniform(-1, 1, 6))
        out.append(obs["sensor_data"]["tactile_right"])
    return out, env.unwrapped.get_state()


def test_episode_is_a_function_of_its_seed_bit_for_bit(make_env):
    env = make_env(obs_mode="tacrgb+tacff", render_backend="none")
    touch, state = rollout(env, seed=3)
    rollout(env, seed=4)
    again, state_again = rollout(env, seed=3)
    fresh, state_fresh = rollout(make_env(obs_mode="tacrgb+tacff", render_backend="none"), seed=3)
    assert torch.equal(state, state_again)
    assert torch.equal(state, state_fresh)
    for first, second, third in zip(touch, again, fresh, strict=True):
        for key in first:
            assert torch.equal(first[key], second[key])
            assert torch.equal(first[key], third[key])


def test_environments_to_reset_can_be_listed(make_env):
    env = make_env(obs_mode="state", render_backend="none")
    first = env.reset(seed=1)[0]
    env.step(env.action_space.sample())
    assert env.reset(seed=1, options=dict(env_idx=[0]))[0].equal(first)


@pytest.mark.parametrize("env_idx", [[], [1], [-1], [0, 0], 0, [0.0], "a", torch.tensor([True])])
def test_what_is_no_list_of_environments_is_refused(make_env, env_idx):
    env = make_env(obs_mode="state", render_backend="none")
    env.reset(seed=1)
    before = env.step(np.full(6, 0.3))[0]
    with pytest.raises(InvalidArgumentError, match=r"env_idx=.*from 0 to 0"):
        env.reset(options=dict(env_idx=env_idx))
    assert torch.equal(env.unwrapped.get_obs(), before)


def test_a_list_without_a_seed_is_refused(make_env):
    with pytest.raises(InvalidArgumentError, match=r"seed=\[\]"):
        make_env(obs_mode="state", render_backend="none").reset(seed=[])


def test_looking_twice_changes_nothing(make_env):
    env = make_env(obs_mode="tacff", render_backend="none")
    env.reset(seed=0)
    obs, *_ = env.step(np.full(6, 0.5))
    twice = env.unwrapped.get_obs()
    assert torch.equal(obs["sensor_data"]["tactile_right"]["force_field"], twice["sensor_data"]["tactile_right"]["force_field"])


def test_info_is_that_of_its_step_for_good(make_env):
    env = make_env(obs_mode="state", render_backend="none")
    infos = [env.reset(seed=0)[1], *(env.step(np.zeros(6))[-1] for _ in range(2))]
    env.reset()
    assert [info["elapsed_steps"].item() for info in infos] == [0, 1, 2]


def test_changing_an_observation_does_not_change_the_sensors_reading(make_env):
    env = make_env(obs_mode="tacff", render_backend="none")
    field = env.reset(seed=0)[0]["sensor_data"]["tactile_right"]["force_field"]
    felt = field.clone()
    field.zero_()
    assert torch.equal(env.unwrapped.get_obs()["sensor_data"]["tactile_right"]["force_field"], felt)


def test_touch_is_computed_once_a_step_and_only_where_asked_for(make_env, monkeypatch):
    captures = []
    capture = TactileSensor.capture
    monkeypatch.setattr(TactileSensor, "capture", lambda self, *args: (captures.append(self.uid), capture(self, *args)))
    env = make_env(obs_mode="tacff", tactile_sensors=("left",), render_backend="none")
    env.reset(seed=0)
    captures.clear()
    for _ in range(3):
        env.step(np.zeros(6))
    assert captures == ["tactile_left"] * 3
    env = make_env(obs_mode="state", render_backend="none")
    env.reset(seed=0)
    captures.clear()
    env.step(np.zeros(6))
    assert captures == []


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
def test_cameras_stand_where_the_paper_has_them_and_look_30_degrees_down(make_env):
    """Position and view in the base frame, or in the frame of the hand; x ahead and z up in SAPIEN's cameras."""
    slant = np.array([np.cos(np.pi / 6), -np.sin(np.pi / 6)])
    views = {"front": ((0.68, 0.0, 0.15), (-slant[0], 0.0, slant[1])), "side": ((0.5, -0.17, 0.17), (0.0, *slant))}
    env = make_env(obs_mode="rgb", cameras=("front", "side", "wrist"), sensor_configs=dict(width=32, height=32))
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


def test_contact_force_is_the_weight_at_rest_and_the_largest_force_of_a_step(make_env):
    env = make_env(obs_mode="none", render_backend="none")
    assert env.reset(seed=0)[1]["contact_force"].item() == 0
    base, still = env.unwrapped, np.zeros(6)
    weight = 9.81 * base.plug.mass.item()
    for _ in range(3):
        *_, info = env.step(still)
    assert info["contact_force"].item() == pytest.approx(weight, rel=0.03)
    base.plug._bodies[0].add_force_torque([0.0, 0.0, 30.0], [0.0, 0.0, 0.0])  # in the first physics step alone
    *_, info = env.step(still)
    assert info["contact_force"] > 5 * weight
    env.step(still)
    *_, info = env.step(still)
    assert info["contact_force"].item() == pytest.approx(weight, rel=0.03)


def test_an_episode_without_a_seed_keeps_nothing_of_the_one_before(make_env):
    env = make_env(obs_mode="none", render_backend="none")
    env.reset(seed=0)
    env.step(np.zeros(6))
    base = env.unwrapped
    base._steps_at_goal[:], base._success_paper[:] = 5, True
    _, info = env.reset()
    assert not info["success"]
    assert not info["success_paper"]
    assert info["contact_force"] == 0
    assert info["elapsed_steps"] == 0


def test_force_field_equals_the_wrench_and_the_weight(make_env):
    env = make_env(obs_mode="tacff", tactile_sensors=("left", "right"), render_backend="none")
    for seed in range(3):
        obs, _ = env.reset(seed=seed)
        for _ in range(5):
            obs, *_ = env.step(np.zeros(6))
        base, total = env.unwrapped, torch.zeros(3)
        for side in ("left", "right"):
            field = obs["sensor_data"][f"tactile_{side}"]["force_field"][0].sum((0, 1))
            fx, fy, fz, *_ = base.agent.pad_wrench(side)[0].tolist()
            assert field.tolist() == pytest.approx([-fz, fx, fy], rel=0.01, abs=1e-3)
            rotation = torch.as_tensor(base.agent.gels[side].pose.sp.to_transformation_matrix()[:3, :3]).float()
            total += rotation @ torch.tensor([field[1], field[2], -field[0]])
        weight = float(base.plug.mass[0]) * 9.81
        assert total.tolist() == pytest.approx([0, 0, -weight], abs=0.02 * weight)


def test_sensor_configs_reach_pads_as_well(make_env):
    pad = dict(units="tacsl", optics=dict(noise=2.0))
    env = make_env(obs_mode="tacff", render_backend="none", sensor_configs=dict(tactile_right=pad, width=64)).unwrapped
    config = env._tactile_sensors["tactile_right"].config
    assert (config.units, config.optics.noise) == ("tacsl", 2.0)


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


@pytest.mark.parametrize("mode", ["pd_ee_delta_pose_fixed_gripper", "pd_joint_target_delta_pos"])
def test_a_flat_state_holds_the_targets_of_arm_and_gripper(make_env, mode):
    """The same actions from the same state end in the same state, in an environment that was somewhere else before."""
    first, second = (make_env(obs_mode="none", render_backend="none", control_mode=mode) for _ in range(2))
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.3, 0.3, (8, *first.action_space.shape))
    ends = []
    first.reset(seed=0)
    for action in actions[:4]:
        first.step(action)
    state = first.unwrapped.get_state()
    for env, seed in ((first, 0), (second, 1)):
        env.reset(seed=seed)
        env.unwrapped.set_state(state)
        assert env.unwrapped.get_state() == pytest.approx(state, abs=1e-6)
        for action in actions[4:]:
            env.step(action)
        ends.append(env.unwrapped.get_state())
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)
    with pytest.raises(ValueError, match=r"get_state returns \(N, "):
        first.unwrapped.set_state(state[:, :-1])


def test_every_episode_draws_its_own_touch_and_a_seed_begins_anew(make_env):
    """Without a seed ManiSkill keeps the last one in a reset; the draws of touch are new all the same."""
    kwargs = dict(imperfections=dict(gain=(0.0, 0.2)), tactile={"randomization.stiffness": 0.3})
    env = make_env(obs_mode="tacff", render_backend="none", **kwargs)

    def drawn() -> tuple[float, float]:
        sensor = env.unwrapped._tactile_sensors["tactile_right"]
        return sensor.drawn_imperfections["gain"].sum().item(), sensor.model._gel.normal_stiffness.sum().item()

    env.reset(seed=3)
    episodes = [drawn()]
    for _ in range(3):
        env.reset()
        episodes.append(drawn())
    assert all(len(set(values)) == 4 for values in zip(*episodes, strict=True))
    env.reset(seed=3)
    assert drawn() == episodes[0]
    env.reset()
    assert drawn() == episodes[1]


def test_pads_on_fingers_of_different_sizes_are_refused(make_env):
    options = dict(obs_mode="tacff", render_backend="none", sensor_configs=dict(tactile_left={"gel.size": (0.026, 0.034)}))
    with pytest.raises(InvalidArgumentError, match="both fingers are alike"):
        make_env(tactile_sensors=("left", "right"), **options)
    assert make_env(tactile_sensors=("left",), **options).unwrapped._finger.gel_size == (0.026, 0.034)


def test_an_action_is_copied_when_it_is_checked():
    """A policy may write its next action into the same memory."""
    action = torch.zeros(6)
    checked = checked_action(action, [(6,)])
    action += 1
    assert checked.abs().sum() == 0


def test_two_pads_are_two_sensors(make_env):
    """Both pads of the same kind, in the same episode: neither their imperfections nor their noise are the same."""
    amounts = dict(gain=(0.0, 0.2), noise=0.05, dead_taxels=0.1)
    env = make_env(obs_mode="tacff", render_backend="none", tactile_sensors=("left", "right"), imperfections=amounts)
    _, info = env.reset(seed=0)
    left, right = (info["imperfections"][f"tactile_{side}"] for side in ("left", "right"))
    assert not torch.equal(left["gain"], right["gain"])
    noise = [env.unwrapped._tactile_sensors[f"tactile_{side}"].model._imperfections._seed for side in ("left", "right")]
    assert not torch.equal(*noise)


@pytest.mark.parametrize("seed", [None, 5])
@pytest.mark.parametrize("flat", [False, True])
def test_an_episode_that_begins_in_a_given_state_begins_anew(make_env, seed, flat):
    env = make_env(obs_mode="tacff", render_backend="none")
    base = env.unwrapped
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample() * 0.3)
    tree, vector = base.get_state_dict(), base.get_state()
    base._steps_at_goal[:] = 5
    _, info = env.reset(seed=seed, options=dict(reset_to_env_states=dict(env_states=vector if flat else tree)))
    assert not info["success"]
    assert info["elapsed_steps"] == 0
    assert base.get_state() == pytest.approx(vector, abs=1e-6)
    with pytest.raises(InvalidArgumentError, match="holds no env_states; give"):
        env.reset(options=dict(reset_to_env_states=tree))


def test_a_state_of_other_bodies_does_not_begin_an_episode(make_env):
    env = make_env(obs_mode="tacff", render_backend="none")
    env.reset(seed=0)
    state = env.unwrapped.get_state_dict()
    body = torch.zeros(1, 13)
    for given, said in (
        ({}, "holds no body; this environment has .*articulations/panda_gelsight"),
        (dict(controller=state["controller"]), "holds no body"),
        (dict(actors={}), "holds no body"),
        (state | dict(goal=body), r"holds \['goal'\]"),
        (dict(actors=dict(cup=body), articulations=state["articulations"]), r"holds \['actors/cup'\]"),
        (dict(actors=body), r"env_states\['actors'\]=.* must be a dict"),
    ):
        with pytest.raises(InvalidArgumentError, match=said):
            env.reset(options=dict(reset_to_env_states=dict(env_states=given)))
        assert is_part_of(state, env.unwrapped.get_state_dict())
    without_controller = dict(actors=state["actors"], articulations=state["articulations"])  # as other programs write it
    env.reset(options=dict(reset_to_env_states=dict(env_states=without_controller)))


def test_touch_after_a_state_is_set_is_that_of_the_state(make_env):
    """Neither forces nor drives are part of a state; the gripped peg is felt again as soon as its state is set."""
    env = make_env(obs_mode="tacff", render_backend="none")
    base = env.unwrapped
    obs, _ = env.reset(seed=0)

    def pressing(obs) -> float:
        return obs["sensor_data"]["tactile_right"]["force_field"][..., 0].sum().item()

    gripped, force = base.get_state_dict(), pressing(obs)
    assert force > 10
    base.plug.set_pose(sapien.Pose([0.0, 0.6, 0.3]))
    for _ in range(8):
        obs, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
    assert pressing(obs) == 0
    base._steps_at_goal[:] = 5
    base.set_state_dict(gripped)
    assert pressing(base.get_obs()) == pytest.approx(force, rel=0.01)
    assert not base.evaluate()["success"]  # the peg is in the hand


def test_a_gel_that_is_caught_from_behind_is_not_taken_for_one_on_the_wrong_side(make_env, monkeypatch, caplog):
    """The peg presses both gels at the start, so that they face the right way, whatever pulls them later."""
    env = make_env(obs_mode="tacff", render_backend="none")
    env.reset(seed=0)
    sensor = env.unwrapped._tactile_sensors["tactile_right"]
    pulled = torch.tensor([[0.0, 0.0, 2.0, 0.0, 0.0, 0.0]], dtype=sensor.wrench().dtype)
    monkeypatch.setattr(sensor, "wrench", lambda: pulled)
    sensor.capture()
    assert "faces away" not in caplog.text
