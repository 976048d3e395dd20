"""The shipped sample demonstrations, replayed from their seeds: the tasks' outcomes and their rewards."""

from functools import cache

import gymnasium as gym
import h5py
import numpy as np
import pytest

from manifeel_ms3.demonstrations.formats.maniskill_h5 import read_header
from manifeel_ms3.paths import data_dir
from manifeel_ms3.tasks.registry import all_tasks

TASKS = sorted(name for name in all_tasks() if name.startswith("ManiFeel-"))
SAMPLE_REVISIONS = dict.fromkeys(TASKS, 1)
"""Revision of each task with which its sample was recorded."""
SAME_PLACE = 1e-6
"""Largest difference of a final pose, in m and of a quaternion's components. On the machine of the recording it is 0; other
processors may round differently, which moves a part by less than this, whereas a change of the task moves it by more."""
HOW_TO_MEND = (
    "the sample of {task} has another outcome than when it was recorded: "
    "raise the revision of {task} in its register_task(...) and record the sample anew"
)


@cache
def replayed(task: str) -> tuple[dict, dict[str, np.ndarray], dict, np.ndarray, dict[str, np.ndarray]]:
    """The first episode as it was recorded (header, final poses) and as it is now (last info, rewards, final poses)."""
    path = data_dir() / "sample" / task / "states.h5"
    episode = read_header(path)["episodes"][0]
    with h5py.File(path) as file:
        trajectory = file[f"traj_{episode['episode_id']}"]
        actions = trajectory["actions"][()]
        recorded = {name: poses[-1] for name, poses in trajectory["env_states/actors"].items()}
    env = gym.make(
        task,
        obs_mode="none",
        reward_mode="normalized_dense",
        control_mode=episode["control_mode"],
        sim_backend="physx_cpu",
        render_backend="none",
    )
    env.reset(seed=episode["episode_seed"])
    info, rewards = {}, []
    for action in actions:
        _, reward, *_, info = env.step(action)
        rewards.append(float(reward))
    final = {name: state[0].cpu().numpy() for name, state in env.unwrapped.get_state_dict()["actors"].items()}
    env.close()
    return episode, recorded, info, np.array(rewards), final


@pytest.mark.parametrize("task", TASKS)
def test_outcome_of_the_sample_has_not_changed(task):
    episode, recorded, info, rewards, final = replayed(task)
    complaint = HOW_TO_MEND.format(task=task)
    assert all_tasks()[task].revision == SAMPLE_REVISIONS[task], f"record the sample of {task} with its new revision"
    assert bool(info["success"]) == episode["success"], complaint
    assert len(rewards) == episode["elapsed_steps"], complaint
    assert set(final) == set(recorded), complaint
    for name, state in recorded.items():
        assert np.abs(final[name][:7] - state[:7]).max() <= SAME_PLACE, f"{name}: {complaint}"


@pytest.mark.parametrize("task", TASKS)
def test_rewards_are_normalised_and_rise_to_the_goal(task):
    _, _, info, rewards, _ = replayed(task)
    assert info["success"].all()
    assert rewards.min() >= 0.0
    assert rewards.max() <= 1.0
    assert rewards[-1] > 0.9
    first, middle, last = (part.mean() for part in np.array_split(rewards, 3))
    assert first < middle < last
