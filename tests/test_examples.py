"""What the documentation shows, works."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from manifeel_ms3.sensors import pad_pose
from tests.conftest import PEG
from tests.sample import observed_sample

EXAMPLES = Path(__file__).parents[1] / "examples"


def load(name: str):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def squeeze(env):
    """Close the fingers on PickCube's cube, and return the last observation."""
    env.reset(seed=0)
    env.cube.set_pose(env.agent.tcp.pose)
    closed = np.r_[env.agent.robot.get_qpos()[0, :7].numpy(), -1.0]
    for _ in range(10):
        obs, *_ = env.step(closed)
    return obs


def test_touch_in_a_stock_maniskill_task():
    """The Panda squeezes PickCube's cube: the field is what its finger feels."""
    load("touch_in_stock_task")
    code = [line for line in (EXAMPLES / "touch_in_stock_task.py").read_text().splitlines() if line.strip()]
    assert len(code) < 30
    env = gym.make("TouchPickCube-v1", obs_mode="state_dict", render_backend="none", control_mode="pd_joint_pos").unwrapped
    obs = squeeze(env)
    field = obs["extra"]["force_field"]
    contact = env.agent.robot.get_net_contact_forces(["panda_leftfinger"])[0, 0].norm().item()
    assert field[..., 0].sum().item() == pytest.approx(contact, rel=0.02)
    assert contact > 5.0
    assert obs["extra"]["rgb"].shape == (1, 228, 233, 3)
    env.close()
    vector, _ = gym.make("TouchPickCube-v1", obs_mode="state", render_backend="none").reset(seed=0)
    assert vector.shape[1] > 3 * 12 * 12


def test_a_pad_on_the_wrong_side_is_named(monkeypatch, caplog):
    """The pose of the left finger's pad, on the right finger: the gel is pulled, and reads zero."""
    example = load("touch_in_stock_task")
    right = replace(example.PAD, link="panda_rightfinger")
    monkeypatch.setattr(example, "PAD", right)
    env = example.TouchPickCubeEnv(obs_mode="state_dict", render_backend="none", control_mode="pd_joint_pos")
    squeeze(env)
    assert "'touch' is pulled by" in caplog.text
    assert caplog.text.count("faces away from what it touches") == 1
    env.close()
    caplog.clear()
    across = pad_pose(facing=(0, 1, 0), tip=(0, 0, 1), at=(0, 0, 0.0465))
    monkeypatch.setattr(example, "PAD", replace(right, pad_pose=across))
    env = example.TouchPickCubeEnv(obs_mode="state_dict", render_backend="none", control_mode="pd_joint_pos")
    assert squeeze(env)["extra"]["force_field"][..., 0].sum().item() > 5.0
    assert not caplog.text
    env.close()


def test_our_recordings_feed_the_loader_of_maniskills_diffusion_policy():
    """Its observations are those that the wrapper makes in evaluation."""
    example = load("diffusion_policy_loader")
    batch = example.main(observed_sample(PEG))
    assert batch["observations"]["rgb"].shape == (8, 2, 128, 128, 3)
    assert batch["observations"]["state"].shape == (8, 2, 25 + 420)
    assert batch["actions"].shape == (8, 16, 6)
    dataset = example.DiffusionPolicyDataset(observed_sample(PEG))
    first, last = dataset[0], dataset[len(dataset.actions[0]) - 1]
    assert np.array_equal(first["observations"]["state"][0], first["observations"]["state"][1])  # padded
    assert np.array_equal(last["actions"][1], dataset.actions[0][-1])


def test_ppo_improves_a_policy_on_what_it_observes():
    """The networks, the rollout's advantages and the update, without a simulator."""
    ppo = load("ppo")
    args = ppo.Args(num_steps=64, num_envs=4, num_minibatches=4, update_epochs=4, gamma=0.0)
    torch.manual_seed(0)
    agent = ppo.Agent(5, 2)
    envs = SyncVectorEnv([Aim] * args.num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    rollout, (obs, _) = ppo.Rollout(args, envs), envs.reset(seed=0)
    optimizer = torch.optim.Adam(agent.parameters(), 5e-4)
    rewards = []
    for _ in range(30):
        obs, _ = rollout.collect(agent, envs, obs)
        ppo.update(args, agent, optimizer, rollout, rollout.advantages(args, agent.value(ppo.tensor(obs)).detach()))
        agent.watch(rollout.obs.flatten(0, 1))
        rewards.append(rollout.rewards.mean().item())
    assert np.mean(rewards[-5:]) > np.mean(rewards[:5]) + 0.1


class Aim(gym.Env):
    """Rewards actions near the first two numbers of the observation; episodes have 8 steps."""

    observation_space = gym.spaces.Box(-1, 1, (5,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 8
        return self._obs(), {}

    def _obs(self):
        self.seen = self.np_random.uniform(-1, 1, 5).astype(np.float32)
        return self.seen

    def step(self, action):
        self.left -= 1
        reward = -float(np.abs(action - self.seen[:2]).mean())
        return self._obs(), reward, False, self.left == 0, dict(episode=dict(success_once=False))
