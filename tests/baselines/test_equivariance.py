"""When the scene turns about the vertical, the actions of the equivariant policy turn with it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import rotate
from scipy.spatial.transform import Rotation

from baselines.common.encoders import EncoderConfig
from baselines.common.observation import POSE, observation_spec, rotation_6d_pose
from baselines.equivariant_diffusion_policy import train
from baselines.equivariant_diffusion_policy.groups import ORDER, GroupConv, halve, pooled, rotation, turned
from baselines.equivariant_diffusion_policy.image_encoders import EquivariantKeyPoints, EquivariantResNet
from baselines.equivariant_diffusion_policy.networks import ACTION_PAIRS
from baselines.equivariant_diffusion_policy.policy import EquivariantConfig, EquivariantDiffusionPolicy
from manifeel_ms3.agents.panda_gelsight import ACTION_AXES
from manifeel_ms3.errors import InvalidArgumentError, UnknownNameError

SPEC = observation_spec("rgb+tacrgb+tacff", ("front", "wrist"), ("right",), 48, pose="rotation_6d")
FRONT, WRIST, PAD = SPEC.images
PICTURES = range(4)


def smooth_picture(size: int, seed: int = 0) -> np.ndarray:
    """A picture (H, W, 3) in [0, 1] of blobs on black, which end before its rim, so that nothing is lost when it turns."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] / (size - 1) * 2 - 1
    picture = np.zeros((size, size, 3))
    for _ in range(6):
        cx, cy = rng.uniform(-0.4, 0.4, 2)
        picture += rng.uniform(0.3, 1, 3) * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 0.03)[..., None]
    return picture / picture.max()


def turned_picture(picture: np.ndarray, g: int) -> np.ndarray:
    """The picture, turned counter-clockwise, as one looks at it, by g eighths of a turn."""
    if g % 2 == 0:
        return np.rot90(picture, g // 2, axes=(0, 1))
    return np.clip(rotate(picture, 45 * g, axes=(1, 0), reshape=False, order=3), 0, 1)


def as_batch(picture: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.ascontiguousarray(picture), dtype=torch.float32).movedim(-1, 0)[None]


@pytest.mark.parametrize("size", [48, 47])
def test_fields_move_on_by_a_rotation_when_the_picture_turns(size):
    torch.manual_seed(0)
    lift, conv = GroupConv(3, 4, 5, lifting=True), GroupConv(4, 4, 3)
    picture = np.random.default_rng(0).random((size, size, 3))

    def fields(image):
        return halve(conv(lift(as_batch(image)).relu()))[0].unflatten(0, (4, ORDER))

    plain, moved = fields(picture), fields(turned_picture(picture, 2))
    expected = torch.rot90(plain.roll(2, dims=1), 1, dims=(-2, -1))
    assert torch.allclose(moved, expected, atol=1e-5)
    assert not torch.allclose(moved, torch.rot90(plain, 1, dims=(-2, -1)), atol=1e-2)


@pytest.mark.parametrize("size", [48, 47, 7])
def test_pooling_commutes_with_quarter_turns(size):
    fields = torch.rand(2, ORDER, size, size)
    for factor in (2, 3):
        assert torch.equal(pooled(fields.rot90(1, (2, 3)), factor), pooled(fields, factor).rot90(1, (2, 3)))


def test_fields_turn_by_any_angle():
    torch.manual_seed(0)
    fields, angle = torch.randn(4, 3, ORDER), torch.rand(4) * 6
    eighth = torch.full((4,), np.pi / 4)
    assert torch.allclose(turned(fields, eighth), fields.roll(1, 2), atol=1e-5)
    assert torch.allclose(turned(fields, angle + eighth), turned(fields, angle).roll(1, 2), atol=1e-5)
    places = torch.arange(ORDER) * np.pi / 4
    wave = torch.stack([torch.cos(n * places) for n in range(4)]).expand(4, 4, ORDER)
    expected = torch.stack([torch.cos(n * (places - angle[:, None])) for n in range(4)], dim=1)
    assert torch.allclose(turned(wave, angle), expected, atol=1e-5)


def test_the_papers_encoder_has_the_depth_and_fields_of_the_public_code():
    encoder = EquivariantResNet(128)
    convolutions = [module for module in encoder.blocks.modules() if isinstance(module, GroupConv) and module.size == 3]
    widths = [
        (first.weight.shape[1], second.weight.shape[0])
        for first, second in zip(convolutions[::2], convolutions[1::2], strict=True)
    ]
    assert widths == [(8, 8), (8, 16), (16, 32), (32, 64), (64, 128), (128, 128)]
    sides = []
    hooks = [block.register_forward_hook(lambda _m, _i, out: sides.append(out.shape[-1])) for block in encoder.blocks]
    with torch.no_grad():
        assert encoder(torch.rand(1, 3, 230, 230)).shape == (1, 128, ORDER)
    assert (len(hooks), sides) == (6, [226, 113, 56, 28, 14, 7])


@pytest.fixture(scope="module", params=[EquivariantKeyPoints, EquivariantResNet])
def encoded(request):
    """An encoder, pictures, and their features."""
    torch.manual_seed(0)
    encoder, pictures = request.param(64).eval(), [smooth_picture(96, seed) for seed in PICTURES]
    with torch.no_grad():
        return encoder, pictures, encoder(torch.cat([as_batch(picture) for picture in pictures]))


@pytest.mark.parametrize("g", range(1, ORDER))
def test_image_features_turn_with_the_picture(g, encoded):
    encoder, pictures, plain = encoded
    with torch.no_grad():
        moved = encoder(torch.cat([as_batch(turned_picture(picture, g)) for picture in pictures]))
    error = (moved - plain.roll(g, dims=2)).norm() / plain.norm()
    assert error < (1e-4 if g % 2 == 0 else 0.25)  # at 45 degrees every layer's grid is interpolated
    assert error < 0.9 * (moved - plain).norm() / plain.norm()  # nearer than if it had not turned


@pytest.fixture(scope="module", params=["small_cnn", "resnet18"])
def policy(request):
    torch.manual_seed(0)
    small = EncoderConfig(request.param, "small_cnn", force_field="small", tactile_features=16)
    config = EquivariantConfig(encoder=small, hidden=32, down_dims=(32, 64), diffusion_step_embed_dim=32, diffusion_steps=10)
    policy = EquivariantDiffusionPolicy(config, SPEC, action_dim=6)
    poses = torch.as_tensor(rotation_6d_pose(poses_of(40)))
    fields, actions = torch.rand(40, 10, 14, 3), torch.randn(40, 6) * torch.arange(1, 7)
    policy.fit_normalizers({POSE: poses, SPEC.force_fields[0]: fields}, actions)
    return policy.eval()


def poses_of(count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    quaternions = Rotation.random(count, random_state=rng).as_quat()[:, [3, 0, 1, 2]]
    return np.concatenate([rng.uniform([0.4, -0.1, 0.0], [0.6, 0.1, 0.3], (count, 3)), quaternions], axis=1)


def observation(pose: np.ndarray, front: np.ndarray, wrist: np.ndarray) -> dict[str, torch.Tensor]:
    """One window of observations (1, 2, ...) with these poses and pictures."""
    torch.manual_seed(1)
    views = {
        key: torch.as_tensor(np.stack([np.round(255 * picture)] * 2).astype(np.uint8))[None]
        for key, picture in ((FRONT, front), (WRIST, wrist))
    }
    return views | {
        POSE: torch.as_tensor(rotation_6d_pose(pose))[None],
        PAD: torch.randint(0, 255, (1, 2, 48, 48, 3), dtype=torch.uint8),
        SPEC.force_fields[0]: torch.rand(1, 2, 10, 14, 3),
    }


def turned_pose(policy, pose: np.ndarray, g: int) -> np.ndarray:
    """Poses turned by g eighths of a turn about the vertical through the middle of the demonstrations' positions."""
    normalizer = policy.obs_normalizers[POSE.replace("/", "_")]
    centre = ((normalizer.low + normalizer.high) / 2)[:2].numpy()
    out = pose.copy()
    out[:, :2] = (pose[:, :2] - centre) @ rotation(g).T + centre
    turn = Rotation.from_euler("z", 45 * g, degrees=True)
    out[:, 3:] = (turn * Rotation.from_quat(pose[:, [4, 5, 6, 3]])).as_quat()[:, [3, 0, 1, 2]]
    return out


def turned_actions(actions: torch.Tensor, g: int) -> torch.Tensor:
    turn = torch.as_tensor(rotation(g), dtype=actions.dtype)
    out = actions.clone()
    for pair in ([0, 1], [3, 4]):
        out[..., pair] = actions[..., pair] @ turn.T
    return out


def act(policy, monkeypatch, pose, pictures, noise) -> torch.Tensor:
    """Actions for observations that share a pose, each with a picture of the front camera and one of the wrist camera."""
    monkeypatch.setattr(policy, "noise", lambda *_: noise)
    return torch.cat([policy.sample(observation(pose, *pair), 10, [torch.Generator()]) for pair in pictures])


@pytest.mark.parametrize("g", [1, 2, 4])
def test_actions_turn_when_the_hand_and_the_scene_turn(policy, g, monkeypatch, figure):
    """The front camera's picture turns; the wrist camera turns with the hand, so that its picture stays."""
    pose, noise = poses_of(2), torch.randn(1, 16, 6, generator=torch.Generator().manual_seed(0))
    fronts, wrists = ([smooth_picture(48, seed + shift) for seed in PICTURES] for shift in (0, 100))
    plain = act(policy, monkeypatch, pose, zip(fronts, wrists, strict=True), noise)
    moved = [turned_picture(picture, g) for picture in fronts]  # the noise that generation starts from turns, too
    pairs = zip(moved, wrists, strict=True)
    found = act(policy, monkeypatch, turned_pose(policy, pose, g), pairs, turned_actions(noise, g))
    error = float((found - turned_actions(plain, g)).norm() / plain.norm())
    figure(f"actions after a turn of {45 * g} degrees, relative error", error, at_most=1e-3 if g % 2 == 0 else 0.15)
    assert not torch.allclose(found, plain, rtol=0.05)


@pytest.mark.parametrize("g", [2, 4])
def test_what_the_wrist_camera_sees_is_known_in_the_frame_of_the_scene(policy, g):
    """If the hand alone turns about the vertical, its picture turns the other way, and both together show the same scene."""
    picture, pose = smooth_picture(48), poses_of(2)
    pose[:, 3:] = (Rotation.from_euler("z", 0.3) * Rotation.from_quat([1, 0, 0, 0])).as_quat()[[3, 0, 1, 2]]  # points down
    other = turned_pose(policy, pose, g)
    with torch.no_grad():
        views = []
        for held, seen in ((pose, picture), (other, turned_picture(picture, -g))):
            obs = observation(held, picture, seen)
            normalised = policy.obs_normalizer(POSE).normalize(obs[POSE]).flatten(0, 1)
            views.append(policy.encoder._view(WRIST, obs, normalised))
    assert torch.allclose(*views, atol=1e-4 * float(views[0].abs().max()))


def test_what_touch_feels_matters_and_does_not_turn(policy):
    obs = observation(poses_of(2), smooth_picture(48), smooth_picture(48, 1))
    with torch.no_grad():
        plain = policy.condition(obs)
        pressed = policy.condition(obs | {SPEC.force_fields[0]: 3 * obs[SPEC.force_fields[0]]})
    change = pressed - plain
    assert change.abs().max() > 1e-3
    assert torch.allclose(change, change[:, :1].expand_as(change), atol=1e-6)  # alike in every frame


@pytest.mark.parametrize("policy", ["small_cnn"], indirect=True)
def test_each_row_of_a_batch_has_its_own_answer(policy):
    """Windows, steps and actions of a batch are not mixed up between the frames of the eight rotations."""
    windows = [observation(poses_of(8)[[k, k + 1]], smooth_picture(48, k), smooth_picture(48, k + 9)) for k in range(3)]
    for k, window in enumerate(windows):
        window[PAD] = window[PAD].roll(k, dims=2)
        window[SPEC.force_fields[0]] = window[SPEC.force_fields[0]].roll(k, dims=2)
    together = {key: torch.cat([window[key] for window in windows]) for key in windows[0]}
    actions, steps = torch.randn(3, 16, 6), torch.tensor([1, 4, 9])
    with torch.no_grad():
        conditions = policy.condition(together)
        predicted = policy.action_network(actions, steps, conditions)
        for k, window in enumerate(windows):
            alone = policy.condition(window)
            torch.testing.assert_close(conditions[k : k + 1], alone, rtol=1e-4, atol=1e-5)
            answer = policy.action_network(actions[k : k + 1], steps[k : k + 1], alone)
            torch.testing.assert_close(predicted[k : k + 1], answer, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(conditions[0], conditions[1], rtol=0.01)


def test_vectors_whose_axes_share_a_scale_stay_within_the_range_of_the_networks():
    """Generation cuts what lies beyond."""
    spec = observation_spec("none", (), (), 16, pose="rotation_6d")
    config = EquivariantConfig(encoder=EncoderConfig("small_cnn"), hidden=8, down_dims=(8,), diffusion_step_embed_dim=8)
    policy = EquivariantDiffusionPolicy(config, spec, action_dim=6)
    poses, actions = torch.as_tensor(rotation_6d_pose(poses_of(40))), torch.rand(40, 6) * torch.arange(1, 7) / 6 - 0.1
    policy.fit_normalizers({POSE: poses}, actions)
    for normalised in (policy.obs_normalizer(POSE).normalize(poses), policy.action_normalizer.normalize(actions)):
        assert normalised.abs().max() <= 1 + 1e-6
        assert normalised.abs().amax(0).min() > 0.1


def test_actions_of_an_unknown_size_are_refused(policy):
    with pytest.raises(ValueError, match="ACTION_PAIRS"):
        EquivariantDiffusionPolicy(policy.config, SPEC, action_dim=4)


@pytest.mark.parametrize(("mode", "axes"), ACTION_AXES.items())
def test_what_turns_of_an_action_are_its_horizontal_components(mode, axes):
    pairs = [tuple(axes[i] for i in pair) for pair in ACTION_PAIRS[len(axes)]]
    assert pairs == [("x", "y"), ("roll", "pitch")][: 1 if mode == "pd_ee_delta_yaw" else 2]


@pytest.mark.parametrize("mode", ["pd_joint_pos_fixed_gripper", "pd_ee_pose_fixed_gripper"])
def test_actions_that_do_not_turn_as_vectors_are_refused(mode, demos, tmp_path):
    """Those of the first mode have the size of a motion with the gripper, those of the second that of one without it."""
    copy = Path(shutil.copy(demos, tmp_path / "copy.h5"))
    header = json.loads(demos.with_suffix(".json").read_text())
    header["env_info"]["env_kwargs"]["control_mode"] = mode
    copy.with_suffix(".json").write_text(json.dumps(header))
    settings = dict(demos=(copy,), obs_mode="tacff", cameras=(), steps=1, device="cpu", precision="fp32", compile=False)
    with pytest.raises(InvalidArgumentError, match=rf"copy.h5 are of the control mode '{mode}'.*pd_ee_delta_pose"):
        train.SPEC.train(replace(train.PRESETS["cpu"].args, run_dir=tmp_path / "run", **settings))
    assert not (tmp_path / "run/log.jsonl").exists()


def test_a_pose_that_does_not_turn_as_a_vector_is_refused(policy):
    with pytest.raises(InvalidArgumentError, match="give --pose rotation_6d"):
        EquivariantDiffusionPolicy(policy.config, replace(SPEC, pose="quaternion"), action_dim=6)


@pytest.mark.parametrize("fields", [2, 40, 200])
def test_the_small_network_takes_any_even_number_of_fields(fields):
    with torch.no_grad():
        assert EquivariantKeyPoints(fields)(torch.rand(1, 3, 48, 48)).shape == (1, fields, ORDER)
    with pytest.raises(InvalidArgumentError, match=f"hidden={fields + 1} must be even"):
        EquivariantConfig(encoder=EncoderConfig("small_cnn"), hidden=fields + 1)


def test_an_image_network_that_does_not_turn_is_refused(policy):
    encoder = replace(policy.config.encoder, image="resnet18_keypoints")
    with pytest.raises(UnknownNameError, match=r"choose from \['resnet18', 'small_cnn'\]"):
        EquivariantDiffusionPolicy(replace(policy.config, encoder=encoder), SPEC, action_dim=6)
