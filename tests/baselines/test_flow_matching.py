"""The start of Flow Matching's generation: Gaussian noise, or the uniform noise of the paper's public code."""

import pytest
import torch

from baselines.common.encoders import EncoderConfig
from baselines.common.observation import POSE, observation_spec
from baselines.flow_matching.policy import FlowConfig, FlowMatchingPolicy

WRIST = "sensor_data/wrist/rgb"


@pytest.mark.parametrize("public_code", [False, True])
def test_generation_starts_from_the_noise_of_the_setting(public_code):
    small = dict(encoder=EncoderConfig("small_cnn", image_features=8), down_dims=(8, 16), diffusion_step_embed_dim=8)
    config = FlowConfig(**small, public_code=public_code)
    policy = FlowMatchingPolicy(config, observation_spec("rgb", ("wrist",), (), 16, 16), action_dim=6).eval()
    batch = 40
    obs = {key: torch.zeros(batch, config.obs_horizon, *shape) for key, shape in {POSE: (7,), WRIST: (16, 16, 3)}.items()}
    noise = policy.noise(policy.condition(obs), generators(batch))
    assert noise.shape == (batch, config.pred_horizon, 6)
    if public_code:
        assert 0 <= noise.min() < 0.01 < 0.99 < noise.max() <= 1
        assert abs(noise.mean() - 0.5) < 0.02
    else:
        assert abs(noise.mean()) < 0.05
        assert abs(noise.std() - 1) < 0.05
    assert policy.sample(obs, 2, generators(batch)).shape == (batch, config.action_horizon, 6)
    alone = policy.sample({key: value[7:8] for key, value in obs.items()}, 2, generators(batch)[7:8])
    torch.testing.assert_close(alone, policy.sample(obs, 2, generators(batch))[7:8], rtol=0, atol=1e-5)


@pytest.mark.parametrize("steps", [1, 8, 100, 101, 250])
def test_generation_reaches_the_actions_that_are_predicted(steps):
    config = FlowConfig(encoder=EncoderConfig("small_cnn", image_features=8), prediction="sample")
    policy = FlowMatchingPolicy(config, observation_spec("none", (), (), 16), action_dim=6).eval()
    actions = torch.linspace(-0.9, 0.9, 16 * 6).view(1, 16, 6).expand(3, -1, -1)
    policy.action_network = Always(actions)
    torch.testing.assert_close(policy.generate(torch.zeros(3, 8), steps, generators(3)), actions, rtol=0, atol=1e-4)


class Always(torch.nn.Module):
    """A network that predicts the same actions everywhere."""

    def __init__(self, actions: torch.Tensor):
        super().__init__()
        self.actions = actions

    def forward(self, *_inputs):
        return self.actions


def generators(count: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in range(count)]
