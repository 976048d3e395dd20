"""The sizes of a policy and the networks that generate its actions."""

import pytest
import torch

from baselines.common.encoders import TACRGB_ENCODERS, EncoderConfig, PretrainedEncoder
from baselines.common.observation import POSE, observation_spec
from baselines.common.policy import PolicyConfig, make_action_network
from baselines.common.unet import ConditionalUnet1D, ResidualBlock
from baselines.diffusion_policy.policy import DiffusionConfig, DiffusionPolicy
from manifeel_ms3.errors import InvalidArgumentError

HORIZONS = dict(obs_horizon=2, pred_horizon=16, action_horizon=8)


@pytest.mark.parametrize(
    ("horizons", "said"),
    [
        (dict(action_horizon=16), "pred_horizon=16 must be at least 17"),
        (dict(obs_horizon=10), "pred_horizon=16 must be at least 17"),
        (dict(pred_horizon=0), "pred_horizon=0 must be at least 9"),
        (dict(action_horizon=0), "action_horizon=0 must be at least 1"),
        (dict(obs_horizon=0), "obs_horizon=0 and .* must be at least 1"),
    ],
)
def test_horizons_that_a_prediction_cannot_meet_are_refused(horizons, said):
    with pytest.raises(InvalidArgumentError, match=said):
        PolicyConfig(**HORIZONS | horizons)
    assert PolicyConfig(obs_horizon=9).action_horizon == 8  # the last action of a prediction may be executed


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        (dict(pred_horizon=18), "pred_horizon=18 must be a multiple of 4, as the U-Net halves it between its 3 scales"),
        (dict(pred_horizon=15, down_dims=(8, 16)), "pred_horizon=15 must be a multiple of 2"),
        (dict(down_dims=(12, 16)), r"down_dims=\[12\] must be multiples of n_groups=8"),
        (dict(kernel_size=4), "kernel_size=4 must be odd"),
        (dict(diffusion_step_embed_dim=2), "diffusion_step_embed_dim=2 must be an even number of at least 4"),
        (dict(diffusion_step_embed_dim=63), "diffusion_step_embed_dim=63 must be an even number"),
        (dict(noise_draws=0), "noise_draws=0 must be at least 1"),
        (dict(mlp_width=0), "mlp_width=0 must be at least 1"),
        (dict(n_groups=0), "n_groups=0 must be at least 1"),
        (dict(kernel_size=-1), "kernel_size=-1 must be at least 1"),
        (dict(down_dims=(8, 0)), "down_dims=0 must be at least 1"),
        (dict(down_dims=()), "down_dims=0 must be at least 1"),
    ],
)
def test_sizes_that_no_network_can_have_are_refused(sizes, said):
    with pytest.raises(InvalidArgumentError, match=said):
        PolicyConfig(**sizes)


def test_a_network_of_any_size_that_is_accepted_keeps_the_shape_of_actions():
    for sizes in (
        dict(pred_horizon=17, action_network="mlp"),
        dict(pred_horizon=12, kernel_size=3),
        dict(pred_horizon=18, down_dims=(8, 16)),
        dict(pred_horizon=17, down_dims=(8,), diffusion_step_embed_dim=4),
    ):
        config = PolicyConfig(**dict(down_dims=(8, 8, 8), diffusion_step_embed_dim=8) | sizes)
        actions = torch.zeros(2, config.pred_horizon, 6)
        network = make_action_network(config, 6, 5)
        assert network(actions, torch.zeros(2), torch.zeros(2, 5)).shape == actions.shape


@pytest.mark.parametrize("kind", ["unet", "mlp"])
def test_action_networks_map_actions_to_noise_and_use_step_and_condition(kind):
    config = PolicyConfig(action_network=kind, down_dims=(16, 32, 64), mlp_width=32)
    net = make_action_network(config, action_dim=6, condition_dim=10).eval()
    actions, condition = torch.randn(3, 16, 6), torch.randn(3, 10)
    out = net(actions, torch.tensor([0, 50, 99]), condition)
    assert out.shape == actions.shape
    assert not torch.allclose(out, net(actions, torch.tensor([1, 51, 98]), condition))
    assert not torch.allclose(out, net(actions, torch.tensor([0, 50, 99]), -condition))
    alone = net(actions[1:2], torch.tensor([50]), condition[1:2])
    torch.testing.assert_close(out[1:2], alone, rtol=1e-4, atol=1e-5)


def test_papers_unet_has_the_published_channels():
    net = ConditionalUnet1D(6, 146)
    assert [block[0].second[0].out_channels for block in net.down] == [512, 1024, 2048]


def test_a_residual_block_adds_what_it_computes_to_what_it_is_given():
    block = ResidualBlock(8, 8, condition_dim=3, kernel_size=5, n_groups=4)
    torch.nn.init.zeros_(block.second[0].weight)
    torch.nn.init.zeros_(block.second[0].bias)
    x = torch.randn(2, 8, 16)
    torch.testing.assert_close(block(x, torch.randn(2, 3)), x)


def test_what_the_unet_computes_on_its_way_down_bypasses_its_middle():
    torch.manual_seed(0)
    net = ConditionalUnet1D(6, 10, (16, 32), diffusion_step_embed_dim=8).eval()
    net.middle[-1].register_forward_hook(lambda _block, _inputs, out: torch.zeros_like(out))
    actions, step, condition = torch.randn(2, 16, 6), torch.tensor([3, 3]), torch.randn(1, 10).expand(2, -1)
    first, second = net(actions, step, condition)
    assert not torch.allclose(first, second, atol=1e-3)


def tacrgb_policy(**changes) -> DiffusionPolicy:
    encoder = EncoderConfig("small_cnn", "small_cnn", image_features=8, tactile_features=8, tactile_crop=28)
    spec = observation_spec("tacrgb", (), ("right",), 48, 32)
    return DiffusionPolicy(DiffusionConfig(obs_horizon=1, down_dims=(8,), encoder=encoder, **changes), spec, 6).eval()


def test_pixels_of_touch_are_scaled_by_their_own_ranges_in_the_demonstrations():
    torch.manual_seed(0)
    policy, seen = tacrgb_policy(tacrgb_scale="pixel"), []
    policy.encoder.images[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    (key,) = policy.spec.images
    images = torch.randint(100, 120, (50, 32, 32, 3), dtype=torch.uint8)
    images[:, 5, 6] = 90  # a pixel that never changes
    poses = torch.rand(50, 7)
    policy.fit_normalizers({key: images, POSE: poses}, torch.rand(50, 6))
    policy.condition({key: images[:, None], POSE: poses[:, None]})
    centre = images[:, 2:30, 2:30].movedim(-1, 1).float()
    low, high = centre.amin(0), centre.amax(0)
    expected = (centre - (high + low) / 2) / torch.clamp((high - low) / 2, min=1.0)
    torch.testing.assert_close(seen[0], expected, rtol=0, atol=1e-5)
    assert seen[0].shape[2:] == (28, 28)
    assert (seen[0][:, :, 3, 4] == 0).all()
    assert float(seen[0].abs().max()) <= 1.0


def test_colours_of_touch_are_scaled_alike_unless_told_otherwise():
    policy, seen = tacrgb_policy(), []
    policy.encoder.images[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    images = torch.full((1, 1, 32, 32, 3), 255, dtype=torch.uint8)
    policy.condition({policy.spec.images[0]: images, POSE: torch.zeros(1, 1, 7)})
    assert (seen[0] == 1.0).all()
    assert not any("tactile" in name for name in policy.obs_normalizers)


def test_pretrained_networks_scale_their_images_themselves(monkeypatch):
    monkeypatch.setitem(TACRGB_ENCODERS, "mine", lambda _size, _features: PretrainedEncoder())
    spec, config = observation_spec("tacrgb", (), ("right",), 48, 32), EncoderConfig(tacrgb="mine")
    with pytest.raises(InvalidArgumentError, match=r"tacrgb_scale='pixel': 'mine' scales its images as its authors do"):
        DiffusionPolicy(DiffusionConfig(encoder=config, tacrgb_scale="pixel"), spec, 6)
