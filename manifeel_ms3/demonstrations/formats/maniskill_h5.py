"""Demonstration files: ManiSkill's trajectory h5 + json, written so that a killed run loses nothing that was finished.

While a recording runs, every finished episode is a file of its own in `<name>.episodes/`, and `<name>.h5` is a small index of
links into them, replaced as a whole after each episode. It opens at any time like the finished file, into which
`consolidate` turns it at the end.
"""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import jsonschema
import numpy as np

from manifeel_ms3.errors import InvalidFileError

COMPRESSION_LEVEL = 4  # gzip; lossless


HEADER = {  # what is read of a trajectory's json, as a json schema
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
                "properties": {name: {"type": "integer"} for name in ("episode_id", "episode_seed", "elapsed_steps")},
            },
        },
        "failed_seeds": {"type": "array"},
        "versions": {"type": "object"},
    },
}


class DemonstrationError(InvalidFileError):
    """A demonstration file that cannot be used as asked."""


@dataclass
class Episode:
    """One episode: `arrays` in ManiSkill's tree (actions (T, A), obs/... and env_states/... (T + 1, ...), success (T,), ...),
    `info` its entry in the json."""

    seed: int
    arrays: dict[str, Any]
    info: dict[str, Any] = field(default_factory=dict)


# -------------------------------------------------------------------- writing


def episode_folder(path: Path) -> Path:
    return path.with_suffix(".episodes")


def write_episode(path: Path, episode: Episode) -> None:
    """Write one finished episode beside the trajectory file `path`; it appears whole or not at all."""
    folder = episode_folder(path)
    folder.mkdir(parents=True, exist_ok=True)
    name = f"seed_{episode.seed:08d}"
    partial = folder / f"{name}.h5.partial"
    with h5py.File(partial, "w") as file:
        _write_tree(file.create_group("traj_0", track_order=True), episode.arrays)
    partial.replace(folder / f"{name}.h5")
    write_json(folder / f"{name}.json", episode.info | dict(episode_seed=episode.seed))  # last: it says the rest is there


def _write_tree(group: h5py.Group, tree: dict[str, Any]) -> None:
    for name, value in tree.items():
        if isinstance(value, dict):
            _write_tree(group.create_group(name, track_order=True), value)
        elif value.ndim > 1 and len(value):  # a frame is a chunk: any step can be read alone
            chunks = (1, *value.shape[1:]) if value.ndim > 3 else None
            group.create_dataset(name, data=value, chunks=chunks, compression="gzip", compression_opts=COMPRESSION_LEVEL)
        else:
            group.create_dataset(name, data=value)


def write_json(path: Path, content: Any) -> None:
    """Write a json file that appears whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(content, indent=2))
    partial.replace(path)


def finished_episodes(path: Path) -> dict[int, dict[str, Any]]:
    """Infos of the episodes in `path`, or finished beside it, by seed in rising order."""
    if episode_folder(path).is_dir():
        infos = [json.loads(file.read_text()) for file in sorted(episode_folder(path).glob("seed_*.json"))]
    else:
        infos = read_header(path)["episodes"] if path.is_file() else []
    return {info["episode_seed"]: info for info in infos}


def write_index(path: Path, header: dict[str, Any], infos: dict[int, dict[str, Any]]) -> None:
    """Replace `path` and its json by an index of links to the episodes `infos` (by seed), in that order."""
    folder = episode_folder(path)
    partial = path.with_name(path.name + ".partial")
    with h5py.File(partial, "w") as index:
        for i, seed in enumerate(infos):
            index[f"traj_{i}"] = h5py.ExternalLink(f"{folder.name}/seed_{seed:08d}.h5", "traj_0")
    partial.replace(path)
    write_json(path.with_suffix(".json"), header | dict(episodes=_numbered(infos)))


def consolidate(path: Path) -> None:
    """Turn an index and its episodes into one file; the episodes' folder goes."""
    partial = path.with_name(path.name + ".partial")
    with h5py.File(path, "r") as index, h5py.File(partial, "w") as whole:
        for i in range(len(index)):
            index.copy(index[f"traj_{i}"], whole, f"traj_{i}")
    partial.replace(path)
    shutil.rmtree(episode_folder(path), ignore_errors=True)


def split(path: Path) -> None:
    """Turn a whole file back into an index and its episodes, so that more can be recorded."""
    folder = episode_folder(path)
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
        DemonstrationError: the file or its json is missing, or the json is broken.
    """
    path = Path(path)
    for needed in (path, path.with_suffix(".json")):
        if not needed.is_file():
            raise DemonstrationError(
                f"demonstration file {needed} does not exist; record one with `python -m manifeel_ms3.demonstrations.record`"
            )
    return read_json(path.with_suffix(".json"), HEADER, "a trajectory's json")


def read_json(path: Path, schema: dict[str, Any], kind: str) -> dict[str, Any]:
    """A json file of the form that `schema` asks for.

    Raises:
        DemonstrationError: it is not json, or of another form.
    """
    try:
        content = json.loads(path.read_text())
        jsonschema.validate(content, schema)
    except (ValueError, jsonschema.ValidationError) as error:
        reason = f"{error.json_path}: {error.message[:200]}" if isinstance(error, jsonschema.ValidationError) else error
        raise DemonstrationError(f"{path} is not {kind} ({reason}); copy or record it again") from error
    return content


@contextmanager
def open_trajectories(path: Path) -> Iterator[h5py.File]:
    """Open a trajectory file, to read from it within the context.

    Raises:
        DemonstrationError: it is truncated, not HDF5, or lacks what is read.
    """
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, KeyError) as error:
        raise DemonstrationError(
            f"{path} cannot be read as a trajectory ({error}); it is truncated or of another kind: copy or record it again"
        ) from error


def read_demonstrations(
    path: Path, keys: list[str], env_id: str | None = None, num: int | None = None, progress=iter
) -> list[dict[str, np.ndarray]]:
    """Arrays of every episode (or the first `num`) of a file: `actions` (T, A) and the observations `keys` (T + 1, ...).

    Args:
        keys: such as "sensor_data/wrist/rgb", "sensor_data/tactile_right/force_field", "extra/tcp_pose".
        env_id: the task that the file must be of, if given.
        progress: wraps the iteration over episodes, to show a bar.

    Raises:
        DemonstrationError: missing, truncated, of another task, with too few episodes, or without what `keys` ask for.
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


def each_demonstration(path: Path, keys: list[str], progress=iter) -> Iterator[dict[str, np.ndarray]]:
    """What `read_demonstrations` reads, an episode at a time."""
    header = read_header(path)
    with open_trajectories(path) as file:
        for i in progress(range(len(header["episodes"]))):
            yield _read_episode(file, i, keys, path, header)


def observed(path: Path) -> list[str]:
    """What a file's episodes hold that policies see: pictures, force fields, the tool's pose.

    Raises:
        DemonstrationError: nothing of it.
    """
    with open_trajectories(path) as file:
        sensors: Any = file.get("traj_0/obs/sensor_data", {})
        keys = [
            f"sensor_data/{sensor}/{what}" for sensor in sensors for what in ("rgb", "force_field") if what in sensors[sensor]
        ]
        if "traj_0/obs/extra/tcp_pose" not in file:
            raise DemonstrationError(
                f"{path} holds states and actions alone; `python -m manifeel_ms3.demonstrations.render_observations` adds observations"
            )
    return [*keys, "extra/tcp_pose"]


def _read_episode(file: h5py.File, i: int, keys: list[str], path: Path, header: dict) -> dict[str, np.ndarray]:
    group = file[f"traj_{i}"]
    missing = [key for key in keys if f"obs/{key}" not in group]
    if missing:
        mode = header["env_info"]["env_kwargs"].get("obs_mode")
        raise DemonstrationError(
            f"{path} was recorded with obs_mode={mode!r} and lacks {missing}; record it with an obs_mode, cameras and "
            "tactile_sensors that include them"
        )
    return dict(actions=group["actions"][()]) | {key: group[f"obs/{key}"][()] for key in keys}
