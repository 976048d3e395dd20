"""The shipped sample demonstrations, replayed from their seeds: the tasks' outcomes and their rewards."""

import json
from dataclasses import dataclass
from functools import cache

import gymnasium as gym
import h5py
import numpy as np
import pytest

from manifeel_ms3.demonstrations.dataset import MANIFEST_FILE
from manifeel_ms3.demonstrations.formats.maniskill_h5 import read_header
from manifeel_ms3.demonstrations.recording import STATES_FILE
from manifeel_ms3.paths import data_dir
from manifeel_ms3.tasks.registry import all_tasks
from tests.sample import states_sample

TASKS = sorted(name for name in all_tasks() if name.startswith("ManiFeel-"))
MANIFEST = json.loads((data_dir() / "sample" / MANIFEST_FILE).read_text())
FREE_STEPS = 20
"""Steps before the first contact of any sample; until then a replay repeats the recording on every processor."""
SAME_MOTION = 1e-5
"""Largest difference of a pose during the free steps, in m and of a quaternion's components; 0 on the processor of the
recording, 2e-6 seen on another."""
SAME_PLACE = 1e-2
"""Largest difference of a final pose, in m and of a quaternion's components; 0 on the processor of the recording, 7e-3 seen on
another, where contacts round differently."""
HOW_TO_MEND = (
    "the sample of {task} has another outcome than when it was recorded: "
    "raise the revision of {task} in its register_task(...) and record the sample anew"
)


@dataclass
class Replay:
    """An episode as it was recorded and as it is now."""

    episode: dict
    """Entry of the recording's json."""
    success: bool
    rewards: np.ndarray
    """(T,)"""
    deviation: np.ndarray
    """(T,) largest difference of any object's pose from the recorded one, in m and of a quaternion's components."""


@cache
def replayed(task: str) -> Replay:
    path = states_sample(task)
    episode = read_header(path)["episodes"][0]
    with h5py.File(path) as file:
        trajectory = file[f"traj_{episode['episode_id']}"]
        actions = trajectory["actions"][()]
        recorded = {name: poses[1:, :7] for name, poses in trajectory["env_states/actors"].items()}
    modes = dict(obs_mode="none", reward_mode="normalized_dense", control_mode=episode["control_mode"])
    env = gym.make(task, **modes, sim_backend="physx_cpu", render_backend="none")
    env.reset(seed=episode["episode_seed"])
    info, rewards, deviation = {}, [], []
    for t, action in enumerate(actions):
        _, reward, *_, info = env.step(action)
        rewards.append(float(reward))
        actors = env.unwrapped.get_state_dict()["actors"]
        assert set(actors) == set(recorded), HOW_TO_MEND.format(task=task)
        deviation.append(max(np.abs(actors[name][0, :7].cpu().numpy() - poses[t]).max() for name, poses in recorded.items()))
    env.close()
    return Replay(episode, bool(info["success"]), np.array(rewards), np.array(deviation))


@pytest.mark.parametrize("task", TASKS)
def test_outcome_of_the_sample_has_not_changed(task):
    replay, complaint = replayed(task), HOW_TO_MEND.format(task=task)
    recorded = MANIFEST["files"][f"{task}/{STATES_FILE}"]["revision"]
    assert all_tasks()[task].revision == recorded, f"record the sample of {task} with its new revision"
    assert replay.success == replay.episode["success"], complaint
    assert replay.deviation[:FREE_STEPS].max() <= SAME_MOTION, complaint
    assert replay.deviation[-1] <= SAME_PLACE, complaint


@pytest.mark.parametrize("task", TASKS)
def test_rewards_are_normalised_and_rise_to_the_goal(task):
    replay = replayed(task)
    assert replay.success
    assert replay.rewards.min() >= 0.0
    assert replay.rewards.max() <= 1.0
    assert replay.rewards[-1] > 0.9
    first, middle, last = (part.mean() for part in np.array_split(replay.rewards, 3))
    assert first < middle < last
