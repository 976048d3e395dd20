"""Trajectory files: ManiSkill's h5 with a json beside it, written so that a killed run loses nothing that was finished.

While a recording runs, every finished episode is a file of its own in `<name>.episodes/`, and `<name>.h5` is a small index of
links to them that is replaced as a whole after each episode. The index can be read at any time like the finished file, into
which `consolidate` turns it at the end.
"""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from manifeel_ms3.errors import InvalidFileError, ManifeelError
from manifeel_ms3.files import atomic_write, read_json, write_json

from .demonstration_format import DemonstrationError, DemonstrationFormat, Progress
from .h5_checks import check_trajectories

COMPRESSION_LEVEL = 4
"""Level of gzip, which is lossless; 4 is h5py's default."""
IMAGE_NDIM = 4
"""Axes of an array over time of images or force fields: (T, H, W, channels)."""
COUNT = {"type": "integer", "minimum": 0, "maximum": 2**32 - 1}
"""Json schema of an episode's number, seed or length; numpy's and ManiSkill's seeds are 32 bits wide."""
HEADER = {
    "type": "object",
    "required": ["env_info", "episodes"],
    "properties": {
        "env_info": {
            "type": "object",
            "required": ["env_id", "env_kwargs"],
            "properties": {"env_id": {"type": "string"}, "env_kwargs": {"type": "object"}},
        },
        "episodes": {
            "type": "array",
            "items": {
                "type": "object",
                "required": ["episode_id", "episode_seed", "elapsed_steps", "success"],
                "properties": {
                    **dict.fromkeys(("episode_id", "episode_seed", "elapsed_steps"), COUNT),
                    "control_mode": {"type": "string"},
                    "peak_contact_force": {"type": "number"},
                },
            },
        },
        "failed_seeds": {"type": "array", "items": COUNT},
        "versions": {"type": "object"},
        "revision": {"type": "integer"},
    },
}
"""Json schema of the fields that are read from the json beside a trajectory file."""


@dataclass
class Episode:
    """One recorded episode."""

    seed: int
    """Seed of the reset."""
    arrays: dict[str, Any]
    """Arrays in ManiSkill's tree: actions (T, A), obs/... and env_states/... (T + 1, ...), success (T,), and so on."""
    info: dict[str, Any] = field(default_factory=dict)
    """The episode's entry in the json."""


# -------------------------------------------------------------------- writing


def episode_folder(path: Path) -> Path:
    """Folder in which the episodes of a trajectory file are kept while it is recorded."""
    return path.with_suffix(".episodes")


def write_episode(path: Path, episode: Episode) -> None:
    """Write one finished episode beside the trajectory file `path`; it appears whole or not at all."""
    folder = episode_folder(path)
    name = f"seed_{episode.seed:08d}"
    with atomic_write(folder / f"{name}.h5") as partial, h5py.File(partial, "w") as file:
        _write_tree(file.create_group("traj_0", track_order=True), episode.arrays)
    # written last, because an episode counts as finished once its json exists
    write_json(folder / f"{name}.json", episode.info | dict(episode_seed=episode.seed))


def _write_tree(group: h5py.Group, tree: dict[str, Any]) -> None:
    for name, value in tree.items():
        if isinstance(value, dict):
            _write_tree(group.create_group(name, track_order=True), value)
        elif value.ndim > 1 and len(value):
            chunks = (1, *value.shape[1:]) if value.ndim >= IMAGE_NDIM else None  # one chunk a step, which can be read alone
            group.create_dataset(name, data=value, chunks=chunks, compression="gzip", compression_opts=COMPRESSION_LEVEL)
        else:
            group.create_dataset(name, data=value)


def finished_episodes(path: Path) -> dict[int, dict[str, Any]]:
    """Json entries of the episodes in `path`, or finished beside it, by seed in rising order."""
    if episode_folder(path).is_dir():
        infos = [json.loads(file.read_text()) for file in sorted(episode_folder(path).glob("seed_*.json"))]
    else:
        infos = read_header(path)["episodes"] if path.is_file() else []
    return {info["episode_seed"]: info for info in infos}


def write_index(path: Path, header: dict[str, Any], infos: dict[int, dict[str, Any]]) -> None:
    """Replace a trajectory file by an index of links to finished episodes, and its json accordingly.

    Args:
        path: The trajectory file.
        header: The json but for its episodes.
        infos: Json entries of the episodes by seed, in the order that they shall have.
    """
    folder = episode_folder(path)
    with atomic_write(path) as partial, h5py.File(partial, "w") as index:
        for i, seed in enumerate(infos):
            index[f"traj_{i}"] = h5py.ExternalLink(f"{folder.name}/seed_{seed:08d}.h5", "traj_0")
    write_json(path.with_suffix(".json"), header | dict(episodes=_numbered(infos)))


def consolidate(path: Path) -> None:
    """Turn an index and its episodes into one file, and remove the folder of episodes."""
    with atomic_write(path) as partial, h5py.File(path, "r") as index, h5py.File(partial, "w") as whole:
        for i in range(len(index)):
            index.copy(index[f"traj_{i}"], whole, f"traj_{i}")
    shutil.rmtree(episode_folder(path), ignore_errors=True)


def open_for_more(path: Path) -> None:
    """Prepare a trajectory file for further episodes: where it is whole, put its episodes back into files of their own."""
    folder = episode_folder(path)
    if folder.is_dir() or not path.is_file():
        return
    draft = folder.with_name(folder.name + ".partial")
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir()
    with h5py.File(path, "r") as whole:
        for i, info in enumerate(read_header(path)["episodes"]):
            name = f"seed_{info['episode_seed']:08d}"
            with h5py.File(draft / f"{name}.h5", "w") as file:
                whole.copy(f"traj_{i}", file, "traj_0")
            write_json(draft / f"{name}.json", info)
    draft.rename(folder)


def _numbered(infos: dict[int, dict[str, Any]]) -> list[dict[str, Any]]:
    return [dict(episode_id=i) | {k: v for k, v in info.items() if k != "episode_id"} for i, info in enumerate(infos.values())]


# -------------------------------------------------------------------- reading


def read_header(path: Path) -> dict[str, Any]:
    """The json beside a trajectory file.

    Raises:
        DemonstrationError: The file or its json is missing, or the json is broken.
    """
    path = Path(path)
    for needed in (path, path.with_suffix(".json")):
        if not needed.is_file():
            raise DemonstrationError(
                f"demonstration file {needed} does not exist; record one with `python -m manifeel_ms3.demonstrations.record`"
            )
    try:
        return read_json(path.with_suffix(".json"), HEADER, "a trajectory's json")
    except InvalidFileError as error:
        raise DemonstrationError(str(error)) from error


@contextmanager
def open_trajectories(path: Path) -> Iterator[Any]:
    """Open a trajectory file, to read from it within the context.

    Its structure is checked before anything is read, so that a file from anywhere can be opened (`h5_checks`). The h5py.File is
    typed as Any, because h5py's types cannot tell groups from data sets.

    Raises:
        DemonstrationError: The file is truncated, is not HDF5, lacks what is read, names other files, or declares more numbers
            than it holds.
    """
    path = Path(path)
    try:
        with h5py.File(path, "r") as file:
            check_trajectories(file, path, episode_folder(path))
            yield file
    except ManifeelError:
        raise
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, MemoryError) as error:  # h5py raises all of these
        raise DemonstrationError(
            f"{path} cannot be read as a trajectory ({error}); it is truncated or of another kind: copy or record it again"
        ) from error


def count_episodes(path: Path) -> int:
    """Number of episodes in a trajectory file."""
    return len(read_header(path)["episodes"])


def read_demonstrations(
    path: Path, keys: list[str], env_id: str | None = None, num: int | None = None, progress: Progress = iter
) -> list[dict[str, np.ndarray]]:
    """Arrays of the first episodes of a trajectory file: `actions` (T, A) and the observations `keys` (T + 1, ...).

    Args:
        path: Trajectory file.
        keys: Observations, such as "sensor_data/wrist/rgb", "sensor_data/tactile_right/force_field", "extra/tcp_pose".
        env_id: Id of the task that the file must be of; any task if not given.
        num: Number of episodes; all of them if not given.
        progress: Wraps the iteration over episodes, to show a progress bar.

    Raises:
        DemonstrationError: The file is missing, truncated or of another task, has fewer episodes, or lacks one of the keys.
    """
    path = Path(path)
    header = read_header(path)
    found = header["env_info"]["env_id"].rpartition(":")[2]
    if env_id is not None and found != env_id:
        raise DemonstrationError(f"{path} holds demonstrations of {found}, not of {env_id}; give one recorded for {env_id}")
    count = len(header["episodes"]) if num is None else num
    if not 0 < count <= len(header["episodes"]):
        raise DemonstrationError(
            f"{path} holds {len(header['episodes'])} episodes, {count} are wanted; record more, or ask for fewer"
        )
    with open_trajectories(path) as file:
        return [_read_episode(file, i, keys, path, header) for i in progress(range(count))]


def each_demonstration(path: Path, keys: list[str], progress: Progress = iter) -> Iterator[dict[str, np.ndarray]]:
    """All episodes that `read_demonstrations` reads, one at a time, so that one of them is in memory."""
    header = read_header(path)
    with open_trajectories(path) as file:
        for i in progress(range(len(header["episodes"]))):
            yield _read_episode(file, i, keys, path, header)


def observation_keys(path: Path) -> list[str]:
    """Keys of a file's observations that policies use: images, force fields, and the pose of the tool.

    Raises:
        DemonstrationError: The file holds states and actions alone.
    """
    with open_trajectories(path) as file:
        sensors = file.get("traj_0/obs/sensor_data", {})
        keys = [
            f"sensor_data/{sensor}/{kind}" for sensor in sensors for kind in ("rgb", "force_field") if kind in sensors[sensor]
        ]
        if "traj_0/obs/extra/tcp_pose" not in file:
            raise DemonstrationError(
                f"{path} holds states and actions alone; "
                "`python -m manifeel_ms3.demonstrations.render_observations` adds observations"
            )
    return [*keys, "extra/tcp_pose"]


def _read_episode(file: Any, i: int, keys: list[str], path: Path, header: dict) -> dict[str, np.ndarray]:
    group = file[f"traj_{i}"]
    missing = [key for key in keys if f"obs/{key}" not in group]
    if missing:
        mode = header["env_info"]["env_kwargs"].get("obs_mode")
        raise DemonstrationError(
            f"{path} was recorded with obs_mode={mode!r} and lacks {missing}; record it with an obs_mode, cameras and "
            "tactile_sensors that include them"
        )
    episode = dict(actions=group["actions"][()]) | {key: group[f"obs/{key}"][()] for key in keys}
    steps = len(episode["actions"])
    if wrong := [key for key in keys if episode[key].ndim < 2 or len(episode[key]) != steps + 1]:
        raise DemonstrationError(
            f"{path} has {steps} actions in traj_{i}, and {wrong} of another length than {steps + 1}; record it again"
        )
    return episode


MANISKILL_H5 = DemonstrationFormat(
    "maniskill", matches=lambda path: not Path(path).is_dir(), count=count_episodes, read=read_demonstrations
)
