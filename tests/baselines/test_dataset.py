"""The windows that policies learn from, and the files that they are read from."""

import json
import shutil
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from baselines.common.dataset import SequenceDataset, read_episodes, recorded_env_kwargs
from baselines.common.observation import POSE, observation_spec
from manifeel_ms3.demonstrations import DemonstrationError, read_demonstrations
from tests.sample import observed_sample
from tests.tasks_and_marks import PEG
from tests.trajectories import changed_copy

SPEC = observation_spec("tacff", (), ("right",), 64)
FIELD = SPEC.force_fields[0]
HORIZONS = dict(obs_horizon=2, pred_horizon=16, action_horizon=8)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def dataset(demos):
    return SequenceDataset(read_episodes([demos], PEG, SPEC, None), SPEC, **HORIZONS, device=CPU)


def test_samples_are_the_windows_of_the_file(demos, dataset):
    episodes = read_demonstrations(demos, SPEC.keys, PEG)
    assert len(dataset) == sum(len(e["actions"]) - 7 for e in episodes)
    second = len(episodes[0]["actions"]) - 7
    for sample, episode, t in ((10, 0, 10), (second + 5, 1, 5)):
        obs, actions = dataset.sample(torch.tensor([sample]))
        assert np.array_equal(obs[FIELD][0].numpy(), episodes[episode][FIELD][t - 1 : t + 1])
        assert np.array_equal(actions[0].numpy(), episodes[episode]["actions"][t - 1 : t + 15])


def test_windows_do_not_cross_episodes(demos, dataset):
    episodes = read_demonstrations(demos, SPEC.keys, PEG)
    last, first = len(episodes[0]["actions"]) - 8, len(episodes[0]["actions"]) - 7
    obs, actions = dataset.sample(torch.tensor([last, first]))
    assert np.array_equal(actions[0, 9:].numpy(), np.repeat(episodes[0]["actions"][-1:], 7, axis=0))
    assert np.array_equal(obs[FIELD][1, 0].numpy(), episodes[1][FIELD][0])
    assert np.array_equal(actions[1, 0].numpy(), episodes[1]["actions"][0])


def test_files_without_episodes_hide_no_others(demos, tmp_path):
    empty = tmp_path / "empty.h5"
    h5py.File(empty, "w").close()
    header = json.loads(demos.with_suffix(".json").read_text())
    empty.with_suffix(".json").write_text(json.dumps(header | dict(episodes=[])))
    assert [len(read_episodes(files, PEG, SPEC, None)) for files in ([demos, empty, demos], [empty, demos])] == [4, 2]
    assert len(read_episodes([empty, demos, empty, demos], PEG, SPEC, 3)) == 3


def test_episodes_that_do_not_succeed_are_counted_in_a_warning(tmp_path, caplog):
    for file in (observed_sample(PEG), observed_sample(PEG).with_suffix(".json")):
        shutil.copy(file, tmp_path)
    path = tmp_path / observed_sample(PEG).name
    read_episodes([path], PEG, SPEC, None)
    assert not caplog.messages
    header = json.loads(path.with_suffix(".json").read_text())
    header["episodes"][1]["success"] = False
    path.with_suffix(".json").write_text(json.dumps(header))
    read_episodes([path], PEG, SPEC, 1)
    assert not caplog.messages
    read_episodes([path], PEG, SPEC, 2)
    assert caplog.messages == [f"{path}: 1 of the first 2 episodes do not succeed"]


def test_no_executed_action_is_padding():
    """The actions count the steps of their episode: an action that repeats its predecessor's number is padding."""
    episodes = [{"actions": np.arange(t, dtype=np.float32)[:, None], POSE: np.zeros((t + 1, 7))} for t in (100, 20, 8)]
    data = SequenceDataset(episodes, observation_spec("none", (), (), 64), **HORIZONS, device=CPU)
    assert len(data) == 93 + 13 + 1  # as in the paper's public code
    _, actions = data.sample(torch.arange(len(data)))
    executed = actions[:, 1:9, 0]
    assert (executed.diff(dim=1) == 1).all()
    assert executed[92].tolist() == list(range(92, 100))


def test_an_episode_shorter_than_the_executed_actions_has_a_sample():
    episodes = [{"actions": np.arange(t, dtype=np.float32)[:, None], POSE: np.zeros((t + 1, 7))} for t in (3, 9)]
    data = SequenceDataset(episodes, observation_spec("none", (), (), 64), **HORIZONS, device=CPU)
    assert len(data) == 1 + 2
    assert data.sample(torch.tensor([0]))[1][0, :5, 0].tolist() == [0, 0, 1, 2, 2]
    assert data.names(torch.tensor([0, 1, 2])) == "episode 0 step 0, episode 1 step 0, episode 1 step 1"


def test_the_arguments_of_the_recorded_task_are_known(demos):
    assert set(recorded_env_kwargs([demos, demos])) == {"fit"}
    assert recorded_env_kwargs([Path(__file__).parents[1] / "demonstrations/lerobot/images"]) == {}
    with pytest.raises(DemonstrationError, match=r"was recorded with fit='\w+', .* with fit=None"):
        recorded_env_kwargs([demos, observed_sample(PEG)])


def test_how_another_tool_ran_the_task_is_no_argument_of_it(demos, tmp_path):
    """ManiSkill's replay_trajectory writes all arguments with which it made the environment."""
    replayed = Path(shutil.copy(demos, tmp_path / "replayed.h5"))
    header = json.loads(demos.with_suffix(".json").read_text())
    header["env_info"]["env_kwargs"] |= dict(num_envs=1, render_mode="rgb_array", reward_mode=None)
    replayed.with_suffix(".json").write_text(json.dumps(header))
    assert recorded_env_kwargs([demos, replayed]) == recorded_env_kwargs([demos])


def test_number_of_demonstrations(demos):
    assert len(read_episodes([demos], PEG, SPEC, 1)) == 1
    recorded = [len(episode["actions"]) for episode in read_demonstrations(demos, [])]
    assert recorded[0] != recorded[1]
    assert [len(episode["actions"]) for episode in read_episodes([demos, demos], PEG, SPEC, 3)] == [*recorded, recorded[0]]
    with pytest.raises(DemonstrationError, match="9 demonstrations are wanted, but the files hold"):
        read_episodes([demos], PEG, SPEC, 9)


def test_the_bar_ends_when_all_episodes_are_read(demos, capsys):
    read_episodes([demos, demos], PEG, SPEC, 3)
    assert [line.split("/")[0][-1] for line in capsys.readouterr().out.splitlines()] == ["2", "1"]  # episodes of each file


@pytest.mark.parametrize("key", ["actions", "obs/extra/tcp_pose", f"obs/{SPEC.force_fields[0]}"])
def test_an_episode_that_is_not_finite_is_named_before_it_spoils_the_ranges_of_all(demos, tmp_path, key):
    def with_nan(values):
        values[3].flat[0] = np.nan
        return values

    copy = changed_copy(demos, tmp_path, key, with_nan)
    number = len(read_episodes([demos], PEG, SPEC, None)) - 1
    with pytest.raises(DemonstrationError, match=rf"{copy.name}: .*{key[4:]}.* of episode {number}, .* at step 3"):
        read_episodes([demos, copy], PEG, SPEC, None)


@pytest.mark.parametrize("key", ["actions", f"obs/{SPEC.force_fields[0]}"])
def test_files_of_another_sensor_or_controller_are_refused(demos, tmp_path, key):
    copy = changed_copy(demos, tmp_path, key, lambda values: values[:, 1:])
    with pytest.raises(DemonstrationError, match=rf"{copy.name}: .* has the shape \(\d.*\) at a step, and \(\d"):
        read_episodes([demos, copy], PEG, SPEC, None)


def test_a_state_of_another_length_is_no_pose(demos, tmp_path):
    copy = changed_copy(demos, tmp_path, "obs/extra/tcp_pose", lambda values: np.pad(values, ((0, 0), (0, 1))))
    with pytest.raises(DemonstrationError, match=r"'extra/tcp_pose' of episode 1, .* has the shape \(8,\) .*expected \(7,\)"):
        read_episodes([copy], PEG, SPEC, None)


def test_one_episode_at_its_recorded_size_is_in_memory():
    spec = observation_spec("rgb", ("wrist",), (), 32)
    recorded = read_demonstrations(observed_sample(PEG), spec.keys)
    largest = max(episode[spec.images[0]].nbytes for episode in recorded)
    del recorded
    read_episodes([observed_sample(PEG)], PEG, spec, 1)  # what is imported when it is first used would count, too
    tracemalloc.start()
    episodes = read_episodes([observed_sample(PEG)], PEG, spec, None)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    prepared = sum(values.nbytes for episode in episodes for values in episode.values())
    assert peak < 1.2 * (largest + prepared)
    SequenceDataset(episodes, spec, **HORIZONS, device=CPU)
    assert episodes == []


def test_lerobot_datasets_are_read_beside_files(demos):
    pytest.importorskip("pyarrow")
    folder = Path(__file__).parents[1] / "demonstrations/lerobot/images"
    episodes = read_episodes([folder, demos], PEG, SPEC, None)
    assert [len(episode["actions"]) for episode in episodes[:2]] == [4, 3]
    steps = [len(episode["actions"]) for episode in episodes]
    assert episodes[0][POSE].shape == (5, 7)
    assert len(SequenceDataset(episodes, SPEC, 2, 16, 1, CPU)) == sum(steps)
