"""The zarr layout of the paper's own data (Diffusion Policy's replay buffer): read as demonstrations, and written.

`data/` holds the steps of all episodes one after the other, and `meta/episode_ends` the step at which each one ends. The arrays
are the cameras under their names (uint8), `right_tactile_camera_taxim` (float in [0, 1], 320 x 240: TacRGB turned by 90
degrees), `tactile_force_field_right` (10 x 14 x 3), `state` (pose of the tool, m and xyzw) and `action`.

The paper's stores say nothing of their task. Their force fields hold penetration and sliding speed (units="tacsl"). The stores
that are written here name the task and its arguments, the units among them, in the attributes of the root group.
"""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from manifeel_ms3.command_line import missing_extras_named
from manifeel_ms3.tasks.obs_modes import PAD, POSE

from .demonstration_format import Demonstration, DemonstrationError, DemonstrationFormat, Progress, require_form
from .folder_checks import broken_if_fails, read_origin, require_task
from .maniskill_h5 import about_task, observation_keys, read_header, read_trajectories, require_same_form
from .touch_units import recorded_units
from .zarr_arrays import open_arrays

ENDS, ACTION = "meta/episode_ends", "data/action"
"""Arrays that every store has."""
ATTRIBUTES = ".zattrs"
"""File of the attributes of a store of zarr format 2."""
ABOUT = {
    "type": "object",
    "properties": {"env_id": {"type": "string"}, "env_kwargs": {"type": "object"}},
}
"""Json schema of the attributes that are read."""
PAPERS_ARGUMENTS: dict[str, Any] = {"tactile": {"units": "tacsl"}}
"""Arguments of the environment with which the sensor gives the quantities of the paper's stores."""
MOST_PENETRATION = 0.02
"""Penetration, in m, above which a force field cannot be in the paper's units: five times the thickness of the gel."""
STEPS_PER_CHUNK = 64
"""Number of steps in a chunk of an array; set once, not tuned."""
XYZW = [0, 1, 2, 4, 5, 6, 3]
"""Order that turns a pose with a quaternion wxyz into one with xyzw."""
WXYZ = [0, 1, 2, 6, 3, 4, 5]
"""Order that turns a pose with a quaternion xyzw into one with wxyz."""


def is_zarr(path: Path) -> bool:
    """Whether a folder is a zarr store in the paper's layout."""
    return (Path(path) / "meta").is_dir() and (Path(path) / "data").is_dir() and not (Path(path) / "meta/info.json").is_file()


def array_name(key: str) -> str:
    """The paper's name of an observation, such as "wrist" for "sensor_data/wrist/rgb"."""
    if key == POSE:
        return "state"
    _, sensor, kind = key.split("/")
    if not sensor.startswith(PAD):
        return sensor
    side = sensor.removeprefix(PAD)
    return f"{side}_tactile_camera_taxim" if kind == "rgb" else f"tactile_force_field_{side}"


def recorded_arguments(folder: Path) -> dict[str, Any]:
    """Arguments of the environment that a store names; `PAPERS_ARGUMENTS` if it names none.

    Raises:
        DemonstrationError: The attributes of the store are broken.
    """
    return _attributes(folder).get("env_kwargs", PAPERS_ARGUMENTS)


def _attributes(folder: Path) -> dict[str, Any]:
    return read_origin(Path(folder) / ATTRIBUTES, ABOUT, "the attributes of a zarr store", "export the data set again")


def _require_units(folder: Path, field: np.ndarray, episode: int) -> None:
    """Check that a force field of a store that says nothing of its units can be one of the paper's."""
    most = float(field[..., 0].max(initial=0.0))
    if "env_kwargs" not in _attributes(folder) and most > MOST_PENETRATION:
        raise DemonstrationError(
            f"{folder} does not say in which units its force fields are, and episode {episode} holds {most:.3g}, too much for "
            "the penetration in m of the paper's data; export the data set again, so that it names its units"
        )


def count_episodes(folder: Path) -> int:
    """Number of episodes in a store.

    Raises:
        DemonstrationError: The store is broken.
        MissingExtraError: zarr is not installed.
    """
    arrays = open_arrays(Path(folder), [ENDS, ACTION])
    return len(_ends(Path(folder), arrays))


def read_zarr(
    folder: Path, keys: list[str], num: int | None = None, progress: Progress = iter, env_id: str | None = None
) -> Iterator[Demonstration]:
    """The first episodes of a store, as `read_demonstrations` returns them, one at a time.

    The store does not hold the observation after the last action: the last observation stands there a second time.

    Args:
        folder: Folder of the store.
        keys: Observations to read.
        num: Number of episodes; all of them if not given.
        progress: Wraps the iteration over episodes, to show a progress bar.
        env_id: Id of the task that the episodes must be of, if the store names its task.

    Raises:
        DemonstrationError: The store is broken or of another task, lacks an array, has fewer episodes, asks for decoders that
            could run code, or declares more than it holds; or it holds force fields whose units cannot be known.
        MissingExtraError: zarr is not installed.
    """
    folder = Path(folder)
    names = {key: f"data/{array_name(key)}" for key in keys}
    held = sorted(path.name for path in (folder / "data").glob("*") if path.is_dir())
    if missing := [name for name in (*names.values(), ACTION) if Path(name).name not in held]:
        raise DemonstrationError(f"{folder} lacks {[Path(name).name for name in missing]}; it holds {held}")
    require_task(folder, _attributes(folder), env_id)
    arrays = open_arrays(folder, [ENDS, ACTION, *names.values()])
    ends = _ends(folder, arrays)
    for key, name in names.items():
        require_form(f"{folder}/{name}", key, arrays[name].shape)
    count = len(ends) if num is None else num
    if not 0 < count <= len(ends):
        raise DemonstrationError(f"{folder} holds {len(ends)} episodes, {count} are wanted; ask for fewer")
    for i in progress(range(count)):
        part = slice(ends[i - 1] if i else 0, ends[i])
        with broken_if_fails(folder, f"episode {i}"):
            episode = {key: _from_paper(key, np.asarray(arrays[name][part])) for key, name in names.items()}
            for key in (key for key in keys if key.endswith("/force_field")):
                _require_units(folder, episode[key], i)
            episode = {key: np.concatenate([values, values[-1:]]) for key, values in episode.items()}
            episode["actions"] = np.asarray(arrays[ACTION][part], np.float32)
        yield episode


def _ends(folder: Path, arrays: dict[str, Any]) -> list[int]:
    """The steps at which the episodes end, in rising order, within every array."""
    with broken_if_fails(folder, ENDS):
        ends = np.asarray(arrays[ENDS][:])
    steps = min(array.shape[0] if array.shape else 0 for name, array in arrays.items() if name != ENDS)
    whole = ends.ndim == 1 and ends.dtype.kind in "iu"
    rising = whole and all(start < end <= steps for start, end in pairwise([0, *ends.tolist()]))
    if not rising or len(arrays[ACTION].shape) != 2:
        raise DemonstrationError(
            f"{folder} is no store of the paper's layout: {ENDS} must be rising whole numbers up to the {steps} steps of "
            f"(steps, numbers) in {ACTION}; export the data set again"
        )
    return ends.tolist()


def write_zarr(path: Path, folder: Path, progress: Progress = iter) -> None:
    """Write a trajectory file as a store of zarr format 2, which the paper's code reads.

    Args:
        path: Trajectory file.
        folder: Folder of the store; it is made.
        progress: Wraps the iteration over episodes, to show a progress bar.

    Raises:
        DemonstrationError: The trajectory file is broken, or holds no observations.
        ManifeelError: The sensor is of a package that is not installed, or the arguments of the pads are not allowed.
        MissingExtraError: zarr is not installed.
    """
    with missing_extras_named():
        import zarr
    keys, arrays, ends, first = observation_keys(path), {}, [], {}
    store = zarr.open_group(str(folder), mode="w", zarr_format=2)
    store.attrs.update(_about(path, keys))
    for number, episode in enumerate(read_trajectories(path, keys, progress=progress)):
        first = first or {name: array[:1] for name, array in episode.items()}
        require_same_form(path, number, episode, first)
        length = len(episode["actions"])
        parts = {array_name(key): _to_paper(key, episode[key][:length]) for key in keys} | dict(action=episode["actions"])
        for name, values in parts.items():
            if name not in arrays:
                shape, chunks = (0, *values.shape[1:]), (STEPS_PER_CHUNK, *values.shape[1:])
                arrays[name] = store.create_array(f"data/{name}", shape=shape, chunks=chunks, dtype=values.dtype)
            arrays[name].append(values)
        ends.append(length + (ends[-1] if ends else 0))
    store.create_array(ENDS, data=np.array(ends, np.int64))


def _about(path: Path, keys: list[str]) -> dict[str, Any]:
    """The attributes of a store that is written from these observations of a trajectory file."""
    header = read_header(path)
    env_kwargs = header["env_info"]["env_kwargs"]
    units = recorded_units(env_kwargs, keys)
    same = len(set(units.values())) == 1
    return about_task(header) | dict(force_field_units=next(iter(units.values())) if same else units)


def _from_paper(key: str, values: np.ndarray) -> np.ndarray:
    """An array of the store (T, ...) as the observation of this key."""
    if key == POSE:
        return values[:, WXYZ].astype(np.float32)
    if not key.endswith("/rgb"):
        return values.astype(np.float32)
    if values.dtype != np.uint8:
        values = np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)
    return np.rot90(values, axes=(1, 2)) if "/tactile_" in key else values


def _to_paper(key: str, values: np.ndarray) -> np.ndarray:
    """The observation of this key (T, ...) as an array of the store."""
    if key == POSE:
        return values[:, XYZW]
    if "/tactile_" in key and key.endswith("/rgb"):
        return np.ascontiguousarray(np.rot90(values, -1, axes=(1, 2))).astype(np.float32) / 255
    return values


DIFFUSION_POLICY_ZARR = DemonstrationFormat(
    "zarr", is_zarr, count_episodes, read_zarr, write_zarr, recorded_arguments, lambda folder: _attributes(folder).get("env_id")
)
