"""The zarr layout of the paper's own data (Diffusion Policy's replay buffer): read as demonstrations, and written.

`data/` holds all steps of all episodes one after the other, `meta/episode_ends` where each ends: cameras under their names
(uint8), `right_tactile_camera_taxim` (float in [0, 1], 320 x 240: our pictures on their side), `tactile_force_field_right`
(10 x 14 x 3), `state` (the tool's pose, m and xyzw) and `action`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .maniskill_h5 import DemonstrationError, each_demonstration, observed

ENDS = "meta/episode_ends"
XYZW = [0, 1, 2, 4, 5, 6, 3]  # of a pose whose quaternion is wxyz
WXYZ = [0, 1, 2, 6, 3, 4, 5]


def is_zarr(path: Path) -> bool:
    """Whether a folder is such a store."""
    return (Path(path) / "meta").is_dir() and (Path(path) / "data").is_dir() and not (Path(path) / "meta/info.json").is_file()


def array_name(key: str) -> str:
    """The paper's name of one of our observations ("sensor_data/wrist/rgb")."""
    if key == "extra/tcp_pose":
        return "state"
    _, sensor, what = key.split("/")
    if not sensor.startswith("tactile_"):
        return sensor
    side = sensor.removeprefix("tactile_")
    return f"{side}_tactile_camera_taxim" if what == "rgb" else f"tactile_force_field_{side}"


def count_episodes(folder: Path) -> int:
    return _open(folder)[ENDS].shape[0]


def read_zarr(folder: Path, keys: list[str], num: int, progress: Callable = iter) -> list[dict[str, np.ndarray]]:
    """The first `num` episodes, as `read_demonstrations` gives them; the observation after the last action, which the store
    does not hold, is the last one again.

    Raises:
        DemonstrationError: it is broken, or lacks an array.
        ModuleNotFoundError: the extra is not installed.
    """
    store = _open(folder)
    names = {key: array_name(key) for key in keys}
    held = sorted(store["data"].array_keys())
    if missing := [name for name in (*names.values(), "action") if name not in held]:
        raise DemonstrationError(f"{folder} lacks {missing}; it holds {held}")
    ends = np.asarray(store[ENDS][:])
    starts = np.concatenate([[0], ends[:-1]])
    episodes = []
    for i in progress(range(num)):
        part = slice(int(starts[i]), int(ends[i]))
        episode = {key: _ours(key, np.asarray(store[f"data/{name}"][part])) for key, name in names.items()}
        episode = {key: np.concatenate([values, values[-1:]]) for key, values in episode.items()}
        episodes.append(episode | dict(actions=np.asarray(store["data/action"][part], np.float32)))
    return episodes


def write_zarr(path: Path, folder: Path, progress: Callable = iter) -> None:
    """Write a trajectory file as such a store (zarr format 2, as the paper's code reads).

    Raises:
        DemonstrationError: the file is broken, or holds no observations.
        ModuleNotFoundError: the extra is not installed.
    """
    zarr = _zarr()
    keys, arrays, ends = observed(path), {}, []
    store = zarr.open_group(str(folder), mode="w", zarr_format=2)
    for episode in each_demonstration(path, keys, progress):
        length = len(episode["actions"])
        parts = {array_name(key): _theirs(key, episode[key][:length]) for key in keys} | dict(action=episode["actions"])
        for name, values in parts.items():
            if name not in arrays:
                shape, chunks = (0, *values.shape[1:]), (64, *values.shape[1:])
                arrays[name] = store.create_array(f"data/{name}", shape=shape, chunks=chunks, dtype=values.dtype)
            arrays[name].append(values)
        ends.append(length + (ends[-1] if ends else 0))
    store.create_array(ENDS, data=np.array(ends, np.int64))


def _ours(key: str, values: np.ndarray) -> np.ndarray:
    if key == "extra/tcp_pose":
        return values[:, WXYZ].astype(np.float32)
    if not key.endswith("/rgb"):
        return values.astype(np.float32)
    if values.dtype != np.uint8:
        values = np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)
    return np.rot90(values, axes=(1, 2)) if "/tactile_" in key else values


def _theirs(key: str, values: np.ndarray) -> np.ndarray:
    if key == "extra/tcp_pose":
        return values[:, XYZW]
    if "/tactile_" in key and key.endswith("/rgb"):
        return np.ascontiguousarray(np.rot90(values, -1, axes=(1, 2))).astype(np.float32) / 255
    return values


def _zarr() -> Any:
    try:
        import zarr
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{error}; zarr stores need `pip install manifeel_ms3[zarr]`") from error
    return zarr


def _open(folder: Path) -> Any:
    zarr = _zarr()
    try:
        store = zarr.open_group(str(folder), mode="r")
        _ = store[ENDS], store["data"]
    except (KeyError, ValueError, OSError, zarr.errors.BaseZarrError) as error:
        raise DemonstrationError(
            f"{folder} is no store of the paper's layout ({error}): it must have data/ and {ENDS}; copy it again"
        ) from error
    return store
