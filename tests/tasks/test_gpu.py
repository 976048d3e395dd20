"""Many environments in one process, which need a CUDA GPU."""

import numpy as np
import pytest
import torch
from sapien import physx

from tests.tasks_and_marks import ON_GPU

pytestmark = ON_GPU
NUM_ENVS = 4


@pytest.fixture(scope="module")
def env(make_env):
    try:
        physx.enable_gpu()
    except RuntimeError:
        pytest.skip("this process has simulated on the CPU; run `pytest -m gpu tests/tasks/test_gpu.py` in one of its own")
    return make_env(
        obs_mode="state_dict+tacff",
        num_envs=NUM_ENVS,
        sim_backend="physx_cuda",
        render_backend="none",
        reward_mode="normalized_dense",
    )


def test_actions_are_batched(env):
    obs, _ = env.reset(seed=0)
    before = obs["extra"]["tcp_pose"][:, :3].clone()
    action = torch.zeros(NUM_ENVS, 6)
    action[1, 2] = 1.0
    for _ in range(5):
        obs, reward, _, _, info = env.step(action)
    assert reward.shape == info["success"].shape == (NUM_ENVS,)
    assert obs["sensor_data"]["tactile_right"]["force_field"].shape == (NUM_ENVS, 10, 14, 3)
    risen = (obs["extra"]["tcp_pose"][:, :3] - before)[:, 2].cpu()
    assert risen[1] > 0.03
    assert risen[[0, 2, 3]].abs().max() < 0.002


def test_one_action_is_refused_unless_its_shape_is_known(env):
    env.reset(seed=0)
    with pytest.raises(ValueError, match="the task takes"):
        env.step(np.zeros((NUM_ENVS + 1, 6)))


def test_environments_start_differently_and_repeat_with_their_seed(env):
    first = env.reset(seed=0)[0]["extra"]["socket_pose"].clone()
    other = env.reset(seed=1)[0]["extra"]["socket_pose"].clone()
    again = env.reset(seed=0)[0]["extra"]["socket_pose"]
    assert len(torch.unique(first[:, 0])) == NUM_ENVS
    assert not torch.equal(first, other)
    assert torch.equal(first, again)


def test_partial_reset_leaves_the_other_environments_unchanged(env):
    env.reset(seed=0)
    action = torch.full((NUM_ENVS, 6), 0.3)
    for _ in range(5):
        obs, *_ = env.step(action)
    before = {name: obs["extra"][name].clone() for name in ("tcp_pose", "plug_pose", "socket_pose")}
    after, _ = env.reset(options=dict(env_idx=torch.tensor([2])))
    others = [0, 1, 3]
    for name, poses in before.items():
        assert torch.allclose(after["extra"][name][others], poses[others], atol=1e-5), name
        assert not torch.allclose(after["extra"][name][2], poses[2], atol=1e-3), name


def test_partial_reset_leaves_targets_and_touch_of_the_other_environments_unchanged(make_env):
    imperfect = dict(delay=2, noise=0.02, drift=0.1, hysteresis=0.2)
    options = dict(num_envs=NUM_ENVS, sim_backend="physx_cuda", render_backend="none", imperfections=imperfect)
    env = make_env(obs_mode="state_dict+tacff", **options)
    base, others = env.unwrapped, [0, 1, 3]
    env.reset(seed=0)
    for _ in range(5):
        obs, *_ = env.step(torch.full((NUM_ENVS, 6), 0.3))
    field = obs["sensor_data"]["tactile_right"]["force_field"].clone()
    targets = base.agent.get_controller_state()["arm"]["target_pose"].clone()
    after, _ = env.reset(options=dict(env_idx=torch.tensor([2], device=base.device)))
    assert torch.equal(after["sensor_data"]["tactile_right"]["force_field"][others], field[others])
    assert torch.equal(base.agent.get_controller_state()["arm"]["target_pose"][others], targets[others])
    assert base._tactile_sensors["tactile_right"].model._imperfections.memory["frame"].tolist() == [6, 6, 1, 6]


def test_the_state_of_one_environment_can_be_set(env):
    env.reset(seed=0)
    base = env.unwrapped
    start = base.get_state()
    for _ in range(3):
        env.step(torch.full((NUM_ENVS, 6), 0.3))
    moved = base.get_state()
    base.set_state(start[2:3], torch.tensor([2], device=base.device))
    now = base.get_state()
    assert torch.allclose(now[2], start[2], atol=1e-5)
    assert torch.allclose(now[[0, 1, 3]], moved[[0, 1, 3]], atol=1e-5)
