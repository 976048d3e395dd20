"""What the documentation shows, works."""

import importlib.util
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def load(name: str):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_touch_in_a_stock_maniskill_task():
    """The Panda squeezes PickCube's cube: the field is what its finger feels."""
    load("touch_in_stock_task")
    code = [line for line in (EXAMPLES / "touch_in_stock_task.py").read_text().splitlines() if line.strip()]
    assert len(code) < 30
    env = gym.make("TouchPickCube-v1", obs_mode="state_dict", render_backend="none", control_mode="pd_joint_pos").unwrapped
    env.reset(seed=0)
    env.cube.set_pose(env.agent.tcp.pose)
    closed = np.r_[env.agent.robot.get_qpos()[0, :7].numpy(), -1.0]
    for _ in range(10):
        obs, *_ = env.step(closed)
    field = obs["extra"]["force_field"]
    contact = env.agent.robot.get_net_contact_forces(["panda_leftfinger"])[0, 0].norm().item()
    assert field[..., 0].sum().item() == pytest.approx(contact, rel=0.02)
    assert contact > 5.0
    assert obs["extra"]["rgb"].shape == (1, 240, 320, 3)
    env.close()
