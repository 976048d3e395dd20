"""Recordings of made-up episodes, and the comparison of a recording that was disturbed with one that was not."""

from pathlib import Path

import numpy as np

from manifeel_ms3.demonstrations.formats.maniskill_h5 import open_trajectories, read_header
from manifeel_ms3.demonstrations.formats.maniskill_h5_writing import RecordedEpisode, write_episode
from manifeel_ms3.demonstrations.recording import make_header, open_recording
from tests.tasks_and_marks import PEG
from tests.trajectories import bytes_of

HEADER = make_header(PEG, dict(obs_mode="none")) | dict(failed_seeds=[])
KWARGS = dict(obs_mode="none", render_backend="none", sim_backend="physx_cpu", fit="paper")


def seeds(path: Path) -> list[int]:
    """Seeds of the episodes in a file's json; each episode must have as many actions as the json says."""
    episodes = read_header(path)["episodes"]
    with open_trajectories(path) as file:
        for episode in episodes:
            assert len(file[f"traj_{episode['episode_id']}/actions"]) == episode["elapsed_steps"]
    return [episode["episode_seed"] for episode in episodes]


def assert_same(path: Path, undisturbed: Path) -> None:
    """Check that two recordings are equal, and that a killed one left nothing but its lock."""
    assert path.read_bytes() == undisturbed.read_bytes() or bytes_of(path) == bytes_of(undisturbed)
    assert path.with_suffix(".json").read_text() == undisturbed.with_suffix(".json").read_text()
    assert sorted(file.name for file in path.parent.iterdir() if not file.name.endswith((".lock", ".holder.json"))) == sorted(
        file.name for file in undisturbed.parent.iterdir() if not file.name.endswith((".lock", ".holder.json"))
    )


def made_up(seed: int) -> RecordedEpisode:
    """A small episode, all of whose arrays tell its seed."""
    steps = 3 + seed
    arrays = dict(actions=np.full((steps, 6), seed, np.float32), env_states=dict(peg=np.full((steps + 1, 13), seed)))
    return RecordedEpisode(seed, arrays, dict(elapsed_steps=steps, success=True, peak_contact_force=1.0))


def record_made_up(path: Path, num: int, say=lambda word: None) -> None:
    """What `record` does with its files, without a simulator; episodes finish in another order than they enter the file."""
    with open_recording(path, HEADER, range(20)) as recording:
        if recording.is_complete and len(recording.infos) >= num:
            return
        recording.begin()
        left = [seed for seed in range(num + 1) if seed not in recording.infos and seed not in recording.failed]
        for seed in sorted(left, key=lambda seed: seed ^ 1):
            if seed == 1:
                recording.reject(seed)
            elif seed in recording.kept:
                recording.accept_kept(seed)
            else:
                write_episode(recording.drafts, made_up(seed))
                recording.accept(seed, made_up(seed).info)
            for entered in recording.infos:
                say(str(entered))
        recording.finish()
