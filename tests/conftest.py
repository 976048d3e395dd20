"""Shared fixtures. Tests run on the real simulator; those that need a picture are skipped only where no renderer can be had."""

import os

import gymnasium as gym
import pytest
import torch

import manifeel_ms3  # noqa: F401
from manifeel_ms3.tasks.rendering import available_render_backend

torch.set_num_threads(1)
PEG = "ManiFeel-PegInsertion-v1"
needs_renderer = pytest.mark.skipif(
    available_render_backend() == "none" and not os.environ.get("CI"), reason="no Vulkan renderer on this machine"
)


@pytest.fixture(scope="module")
def make_env():
    """gym.make that closes what it made."""
    made = []

    def make(env_id: str = PEG, **kwargs):
        kwargs = dict(sim_backend="physx_cpu") | kwargs
        made.append(gym.make(env_id, **kwargs))
        return made[-1]

    yield make
    for env in made:
        env.close()
