"""What docs/extending.md shows works."""

import re
from pathlib import Path

import pytest
import torch

from baselines.common.encoders import TACRGB_ENCODERS, EncoderConfig
from baselines.common.observation import POSE, observation_spec
from baselines.common.policy import PolicyConfig

PAGE = (Path(__file__).parents[1] / "docs/extending.md").read_text()
SPEC = observation_spec("tacrgb+tacff", (), ("right",), 32)


@pytest.fixture
def example(monkeypatch):
    """The definitions of a named block; tables that it adds to are put back."""
    monkeypatch.setattr("baselines.common.encoders.TACRGB_ENCODERS", dict(TACRGB_ENCODERS))

    def run(name: str) -> dict:
        (code,) = re.findall(rf"```python\n# {name}\n(.*?)```", PAGE, flags=re.DOTALL)
        scope: dict = {}
        exec(code, scope)
        return scope

    return run


def observation() -> dict[str, torch.Tensor]:
    return {
        POSE: torch.rand(3, 2, 9),
        SPEC.images[0]: torch.randint(0, 255, (3, 2, 32, 32, 3), dtype=torch.uint8),
        SPEC.force_fields[0]: torch.rand(3, 2, 10, 14, 3),
    }


def test_an_encoder_and_a_policy_of_ones_own(example):
    example("encoder")
    encoder = EncoderConfig(tacrgb="flat", force_field="small")
    policy = example("policy")["RegressionPolicy"](PolicyConfig(encoder=encoder, down_dims=(32, 64)), SPEC, 6)
    optimizer = torch.optim.Adam(policy.parameters(), 3e-3)
    obs, actions = observation(), torch.rand(3, 16, 6) * 2 - 1
    losses = []
    for _ in range(60):
        loss = policy(obs, actions)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]
    assert policy.sample(obs, 1, torch.Generator()).shape == (3, 8, 6)
