"""When the scene turns about the vertical, what the equivariant policy does turns with it."""

import numpy as np
import pytest
import torch
from scipy.ndimage import rotate
from scipy.spatial.transform import Rotation

from baselines.common.encoders import EncoderConfig
from baselines.common.observation import POSE, observation_spec, pose_features
from baselines.equivariant_diffusion_policy.groups import ORDER, GroupConv, halve, rotation
from baselines.equivariant_diffusion_policy.networks import EquivariantImageEncoder
from baselines.equivariant_diffusion_policy.policy import EquivariantConfig, EquivariantDiffusionPolicy

SPEC = observation_spec("rgb+tacrgb+tacff", ("front",), ("right",), 48)
CAMERA = SPEC.images[0]
PICTURES = range(8)


def smooth_picture(size: int, seed: int = 0) -> np.ndarray:
    """(H, W, 3) in [0, 1]: blobs that end before the picture's rim, on black: nothing is lost when it turns."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] / (size - 1) * 2 - 1
    picture = np.zeros((size, size, 3))
    for _ in range(6):
        cx, cy = rng.uniform(-0.4, 0.4, 2)
        picture += rng.uniform(0.3, 1, 3) * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 0.03)[..., None]
    return picture / picture.max()


def turned_picture(picture: np.ndarray, g: int) -> np.ndarray:
    """Counter-clockwise, as it is looked at."""
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

    plain, turned = fields(picture), fields(turned_picture(picture, 2))
    expected = torch.rot90(plain.roll(2, dims=1), 1, dims=(-2, -1))
    assert torch.allclose(turned, expected, atol=1e-5)
    assert not torch.allclose(turned, torch.rot90(plain, 1, dims=(-2, -1)), atol=1e-2)


@pytest.mark.parametrize("g", range(1, ORDER))
def test_key_points_turn_with_the_picture(g):
    torch.manual_seed(0)
    encoder = EquivariantImageEncoder(16).eval()
    pictures = [smooth_picture(96, seed) for seed in PICTURES]
    with torch.no_grad():
        plain = encoder(torch.cat([as_batch(picture) for picture in pictures]))
        turned = encoder(torch.cat([as_batch(turned_picture(picture, g)) for picture in pictures]))
    error = (turned - plain.roll(g, dims=0)).norm() / plain.norm()
    assert error < (1e-4 if g % 2 == 0 else 0.25)  # at 45 degrees every layer's grid is interpolated
    assert error < 0.7 * (turned - plain).norm() / plain.norm()  # nearer than if it had not turned


@pytest.fixture(scope="module")
def policy():
    torch.manual_seed(0)
    small = EncoderConfig(image="small_cnn", force_field="small")
    config = EquivariantConfig(encoder=small, hidden=16, down_dims=(32, 64), diffusion_step_embed_dim=32, diffusion_steps=10)
    policy = EquivariantDiffusionPolicy(config, SPEC, action_dim=6)
    poses = torch.as_tensor(pose_features(poses_of(40)))
    fields, actions = torch.rand(40, 10, 14, 3), torch.randn(40, 6) * torch.arange(1, 7)
    policy.fit_normalizers({POSE: poses, SPEC.force_fields[0]: fields}, actions)
    return policy.eval()


def poses_of(count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    quaternions = Rotation.random(count, random_state=rng).as_quat()[:, [3, 0, 1, 2]]
    return np.concatenate([rng.uniform([0.4, -0.1, 0.0], [0.6, 0.1, 0.3], (count, 3)), quaternions], axis=1)


def observation(policy, pose: np.ndarray, picture: np.ndarray) -> dict[str, torch.Tensor]:
    """One window (1, 2, ...)."""
    torch.manual_seed(1)
    return {
        POSE: torch.as_tensor(pose_features(pose))[None],
        CAMERA: torch.as_tensor(np.stack([np.round(255 * picture)] * 2).astype(np.uint8))[None],
        SPEC.images[1]: torch.randint(0, 255, (1, 2, 48, 48, 3), dtype=torch.uint8),
        SPEC.force_fields[0]: torch.rand(1, 2, 10, 14, 3),
    }


def turned_pose(policy, pose: np.ndarray, g: int) -> np.ndarray:
    """About the vertical through the middle of the demonstrations' places."""
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


@pytest.mark.parametrize("g", range(1, ORDER))
def test_actions_turn_with_the_scene(policy, g, monkeypatch):
    pose, noise = poses_of(2), torch.randn(1, 16, 6, generator=torch.Generator().manual_seed(0))

    def act(pose, pictures, noise):
        monkeypatch.setattr(policy, "noise", lambda *_: noise)  # what generation begins with turns, too
        seen = [policy.sample(observation(policy, pose, picture), 10, [torch.Generator()]) for picture in pictures]
        return torch.cat(seen)

    pictures = [smooth_picture(48, seed) for seed in PICTURES]
    plain = act(pose, pictures, noise)
    turned = act(turned_pose(policy, pose, g), [turned_picture(picture, g) for picture in pictures], turned_actions(noise, g))
    error = (turned - turned_actions(plain, g)).norm() / plain.norm()
    assert error < (1e-4 if g % 2 == 0 else 0.15)
    assert not torch.allclose(turned, plain, rtol=0.05)


def test_what_touch_feels_matters_and_does_not_turn(policy):
    obs = observation(policy, poses_of(2), smooth_picture(48))
    with torch.no_grad():
        plain = policy.condition(obs)
        pressed = policy.condition(obs | {SPEC.force_fields[0]: 3 * obs[SPEC.force_fields[0]]})
    change = pressed - plain
    assert change.abs().max() > 1e-3
    assert torch.allclose(change, change[:, :1].expand_as(change), atol=1e-6)  # alike in every frame


def test_actions_of_a_number_that_is_not_known_to_turn(policy):
    with pytest.raises(ValueError, match="ACTION_PAIRS"):
        EquivariantDiffusionPolicy(policy.config, SPEC, action_dim=4)
