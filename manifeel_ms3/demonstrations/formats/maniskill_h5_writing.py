"""Writing of ManiSkill's trajectory files: a process that is killed at any moment loses nothing that was finished.

A trajectory file has one of two forms, and its content tells which:

- While it is recorded it is an index: links to files of one episode each, in the folder `<name>.episodes`. The folder holds
  what was recorded. The index is replaced as a whole after each episode, and can be read like a finished file.
- When it is finished it holds the episodes itself. A folder of episodes beside it is left over from a process that was killed,
  and is removed.

A file changes from one form to the other in a single renaming. Episodes are only ever appended, so that the json, which is
replaced just after the index, names the right episodes even if a kill comes between the two.
"""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import FileIO
from pathlib import Path
from typing import Any

import h5py

from manifeel_ms3.files import atomic_folder, atomic_write, read_json, remove_folder, write_json

from .maniskill_h5 import DemonstrationError, episode_folder, group_of, open_trajectories, read_header

COMPRESSION_LEVEL = 4
"""Level of gzip, which is lossless; 4 is h5py's default."""
IMAGE_NDIM = 4
"""Number of axes of an array over time of images or force fields: (T, H, W, channels)."""
ENTRY = {"type": "object", "required": ["episode_seed"], "properties": {"episode_seed": {"type": "integer"}}}
"""Json schema of what is read from the json beside the file of one episode."""


@dataclass
class RecordedEpisode:
    """One recorded episode."""

    seed: int
    """Seed of the reset."""
    arrays: dict[str, Any]
    """Arrays in ManiSkill's tree: actions (T, A), obs/... and env_states/... (T + 1, ...), success (T,), and so on."""
    info: dict[str, Any] = field(default_factory=dict)
    """The episode's entry in the json."""


def episode_file(folder: Path, seed: int) -> Path:
    """File of one episode in a folder; its entry in the json lies beside it."""
    return folder / f"seed_{seed:08d}.h5"


def write_episode(folder: Path, episode: RecordedEpisode) -> None:
    """Write the file of one episode into a folder.

    Raises:
        FileWriteError: The file cannot be written.
    """
    with _new_h5(episode_file(folder, episode.seed)) as file:
        _write_tree(file.create_group("traj_0", track_order=True), episode.arrays)


def _write_tree(group: h5py.Group, tree: dict[str, Any]) -> None:
    for name, value in tree.items():
        if isinstance(value, dict):
            _write_tree(group.create_group(name, track_order=True), value)
        elif value.ndim > 1 and len(value):
            chunks = (1, *value.shape[1:]) if value.ndim >= IMAGE_NDIM else None  # one chunk a step, which can be read alone
            group.create_dataset(name, data=value, chunks=chunks, compression="gzip", compression_opts=COMPRESSION_LEVEL)
        else:
            group.create_dataset(name, data=value)


class _FileOfHDF5(FileIO):
    """A file whose writes never fail for HDF5, which crashes the process where the disk is full; `failure` keeps the error."""

    failure: OSError | None = None

    def write(self, data: Any) -> int:
        data = memoryview(data).cast("B")
        try:
            written = 0
            while written < len(data) and not self.failure:
                written += super().write(data[written:])
        except OSError as error:
            self.failure = error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.failure = error
            return size or 0


@contextmanager
def _new_h5(path: Path) -> Iterator[h5py.File]:
    """A new HDF5 file, which appears whole or not at all."""
    with atomic_write(path) as partial, _FileOfHDF5(partial, "w+") as raw:
        try:
            with h5py.File(raw, "w") as file:
                yield file
        finally:
            if raw.failure:
                raise raw.failure


def is_index(path: Path) -> bool:
    """Whether a trajectory file is an index of links to episodes, or is empty, as an index is before the first episode.

    Raises:
        DemonstrationError: The file cannot be read.
    """
    with open_trajectories(path) as file:
        return not any(isinstance(file.get(name, getlink=True), h5py.HardLink) for name in file)


def finished_episodes(folder: Path) -> dict[int, dict[str, Any]]:
    """Json entries, by seed, of the episodes in a folder of episodes; an episode is finished once it has its json."""
    infos = [read_json(file, ENTRY, "the json of an episode") for file in sorted(folder.glob("seed_*.json"))]
    return {info["episode_seed"]: info for info in infos}


def indexed_seeds(path: Path) -> list[int]:
    """Seeds of the episodes that an index links to, in the order of the index.

    Raises:
        DemonstrationError: The index cannot be read.
    """
    with open_trajectories(path) as index:
        links = [index.get(f"traj_{i}", getlink=True) for i in range(len(index))]
    return [int(Path(link.filename).stem.removeprefix("seed_")) for link in links]


def write_index(path: Path, header: dict[str, Any], infos: dict[int, dict[str, Any]]) -> None:
    """Replace a trajectory file by an index of links to finished episodes, and its json accordingly.

    Args:
        path: The trajectory file.
        header: The json of the file, without its episodes.
        infos: Json entries of the episodes by seed, in the order of the file.
    """
    folder = episode_folder(path)
    if not path.exists():  # the json says what is recorded before there is a file
        write_json(path.with_suffix(".json"), header | dict(episodes=[]))
    with _new_h5(path) as index:
        for i, seed in enumerate(infos):
            index[f"traj_{i}"] = h5py.ExternalLink(f"{folder.name}/{episode_file(folder, seed).name}", "traj_0")
    write_json(path.with_suffix(".json"), header | dict(episodes=_numbered(infos)))


def _numbered(infos: dict[int, dict[str, Any]]) -> list[dict[str, Any]]:
    return [dict(episode_id=i) | {k: v for k, v in info.items() if k != "episode_id"} for i, info in enumerate(infos.values())]


def consolidate(path: Path) -> None:
    """Turn an index and its episodes into one file, and remove the folder of episodes."""
    with _new_h5(path) as whole, h5py.File(path, "r") as index:
        for i in range(len(index)):
            index.copy(index[f"traj_{i}"], whole, f"traj_{i}")
    remove_folder(episode_folder(path))


def separate(path: Path) -> None:
    """Copy the episodes of a finished file into files of one episode each, so that an index can take its place.

    Raises:
        DemonstrationError: The file cannot be read, lacks an episode, or holds a seed twice.
    """
    episodes = read_header(path)["episodes"]
    infos = {info["episode_seed"]: info for info in episodes}
    with open_trajectories(path) as whole:
        for info in episodes:
            group_of(whole, info)
    if len(infos) < len(episodes):
        raise DemonstrationError(f"{path} holds two episodes of one seed, so that none can be added; give another --out")
    folder = episode_folder(path)
    remove_folder(folder)  # left over from a process that was killed
    with h5py.File(path, "r") as whole, atomic_folder(folder) as draft:
        for seed, info in infos.items():
            with _new_h5(episode_file(draft, seed)) as file:
                whole.copy(group_of(whole, info), file, "traj_0")
            write_json(episode_file(draft, seed).with_suffix(".json"), info)


def remove_recording(path: Path) -> None:
    """Remove a recording that has no episodes."""
    path.unlink(missing_ok=True)
    path.with_suffix(".json").unlink(missing_ok=True)
    shutil.rmtree(episode_folder(path), ignore_errors=True)
