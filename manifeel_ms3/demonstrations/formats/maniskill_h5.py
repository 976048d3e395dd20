"""Reading of trajectory files: ManiSkill's h5 with a json beside it.

While a file is recorded, it is an index of links to the files of its episodes in the folder `<name>.episodes`, and can be read
like the finished file; `maniskill_h5_writing` has the two forms.
"""

import logging
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from manifeel_ms3.errors import InvalidFileError, ManifeelError
from manifeel_ms3.files import read_json
from manifeel_ms3.tasks.obs_modes import POSE

from .demonstration_format import Demonstration, DemonstrationError, DemonstrationFormat, Progress
from .folder_checks import require_task
from .h5_checks import check_trajectories

log = logging.getLogger(__name__)
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
                    "success": {"type": "boolean"},
                    "control_mode": {"type": "string"},
                    "peak_contact_force": {"type": "number"},
                    "versions": {"type": "object"},
                },
            },
        },
        "failed_seeds": {"type": "array", "items": COUNT},
        "versions": {"type": "object"},
        "revision": {"type": "integer"},
    },
}
"""Json schema of the fields that are read from the json beside a trajectory file."""
ORIGIN = ("source_type", "source_desc", "commit_info", "versions", "recorded_with")
"""Fields of the header that say who recorded the episodes, and with which code. An episode's entry has those that differ."""


def episode_folder(path: Path) -> Path:
    """Folder in which the episodes of a trajectory file are kept while it is recorded."""
    return path.with_suffix(".episodes")


def read_header(path: Path) -> dict[str, Any]:
    """The json beside a trajectory file.

    Raises:
        DemonstrationError: The file or its json is missing, or the json is broken.
    """
    path = Path(path)
    if path.is_dir():
        raise DemonstrationError(f"{path} is a folder; give a trajectory file, which ends in .h5")
    if not path.is_file():
        raise DemonstrationError(f"demonstration file {path} does not exist; record one with `manifeel record`")
    beside = path.with_suffix(".json")
    if not beside.is_file():
        raise DemonstrationError(f"{path} lacks its json: {beside} does not exist; copy both files of a recording together")
    try:
        return read_json(beside, HEADER, "a trajectory's json")
    except InvalidFileError as error:
        raise DemonstrationError(str(error)) from error


def task_of(header: dict[str, Any]) -> str:
    """Environment id of the task of a trajectory file, without the module that ManiSkill's files name before a colon.

    Args:
        header: The json beside the file.
    """
    return header["env_info"]["env_id"].rpartition(":")[2]


def about_task(header: dict[str, Any]) -> dict[str, Any]:
    """Id, arguments and, if it is known, revision of the task of a trajectory file, as exported data sets hold them.

    Args:
        header: The json beside the file.
    """
    about = dict(env_id=task_of(header), env_kwargs=header["env_info"]["env_kwargs"])
    return about | ({"revision": header["revision"]} if "revision" in header else {})


def origins(header: dict[str, Any], name: str) -> list[Any]:
    """What a trajectory file says of its episodes' origin: the different values, in the order of the episodes.

    Args:
        header: The json beside the file.
        name: One of `ORIGIN`.

    Returns:
        One value if the episodes agree; more if other sessions continued the file. A value is None where nothing is said.
    """
    values = []
    for episode in header["episodes"]:
        if (value := episode.get(name, header.get(name))) not in values:
            values.append(value)
    return values or [header.get(name)]


def versions_of(header: dict[str, Any]) -> dict[str, str] | None:
    """Versions of the packages that recorded a file, joined by commas where episodes differ; None if an episode says nothing.

    Args:
        header: The json beside the file.
    """
    found = origins(header, "versions")
    if None in found:
        return None
    names = dict.fromkeys(name for versions in found for name in versions)
    return {name: ", ".join(dict.fromkeys(str(one.get(name, "not known")) for one in found)) for name in names}


@contextmanager
def open_trajectories(path: Path) -> Iterator[Any]:
    """Open a trajectory file, to read from it within the context.

    Its structure is checked before anything is read, so that a file from anywhere can be opened (`h5_checks`). The h5py.File is
    typed as Any, because h5py's types cannot tell groups from data sets. What the context itself raises stays as it is.

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
        if not _is_of_h5py(error):
            raise
        raise DemonstrationError(
            f"{path} cannot be read as a trajectory ({error}); it is truncated or of another kind: copy or record it again"
        ) from error


def group_of(file: Any, episode: dict[str, Any]) -> Any:
    """The group of an episode in an opened trajectory file; other programs may number episodes from any number, and with gaps.

    Args:
        file: The opened file.
        episode: The episode's entry in the json.

    Raises:
        DemonstrationError: The file lacks the episode.
    """
    name = f"traj_{episode['episode_id']}"
    if name not in file:
        raise DemonstrationError(
            f"{file.filename} lacks {name}, which its json names; copy both files again, or record them again"
        )
    return file[name]


def actions_of(file: Any, episode: dict[str, Any]) -> np.ndarray:
    """The actions (T, A) of an episode in an opened trajectory file.

    Args:
        file: The opened file.
        episode: The episode's entry in the json.

    Raises:
        DemonstrationError: The file lacks the episode, or has another number of actions than its json says.
    """
    actions = group_of(file, episode)["actions"][()]
    if len(actions) != episode["elapsed_steps"]:
        raise DemonstrationError(
            f"{file.filename} has {len(actions)} actions in traj_{episode['episode_id']}, and its json says "
            f"{episode['elapsed_steps']}: the two files are not of one recording; copy both again"
        )
    return actions


def _is_of_h5py(error: Exception) -> bool:
    """Whether h5py raised an error, as it does for damaged files, and not the code that works with what it read."""
    *_, (frame, _line) = traceback.walk_tb(error.__traceback__)
    return frame.f_globals.get("__name__", "").partition(".")[0] == h5py.__name__


def count_episodes(path: Path) -> int:
    """Number of episodes in a trajectory file."""
    return len(read_header(path)["episodes"])


def read_demonstrations(
    path: Path, keys: list[str], env_id: str | None = None, num: int | None = None, progress: Progress = iter
) -> list[Demonstration]:
    """The first episodes of a trajectory file, all in memory: `actions` (T, A) and the observations `keys` (T + 1, ...).

    Args:
        path: Trajectory file.
        keys: Observations, such as "sensor_data/wrist/rgb", "sensor_data/tactile_right/force_field", "extra/tcp_pose".
        env_id: Id of the task that the file must be of; any task if not given.
        num: Number of episodes; all of them if not given.
        progress: Wraps the iteration over episodes, to show a progress bar.

    Raises:
        DemonstrationError: The file is missing, truncated, of another task or another recording than its json, has fewer
            episodes, or lacks one of the keys.
    """
    return list(read_trajectories(path, keys, num=num, progress=progress, env_id=env_id))


def read_trajectories(
    path: Path,
    keys: list[str],
    num: int | None = None,
    progress: Progress = iter,
    env_id: str | None = None,
    outcomes: tuple[str, ...] = (),
) -> Iterator[Demonstration]:
    """The episodes that `read_demonstrations` returns, one at a time, so that one of them is in memory.

    Args:
        path: Trajectory file.
        keys: Observations to read.
        num: Number of episodes; all of them if not given.
        progress: Wraps the iteration over episodes, to show a progress bar.
        env_id: Id of the task that the file must be of, in its present revision; any task if not given.
        outcomes: Arrays (T,) of what followed the actions, such as "success", that are read where the file has them.

    Raises:
        DemonstrationError: The file is missing, truncated, of another task or another recording than its json, has fewer
            episodes, or lacks one of the keys.
    """
    path = Path(path)
    header = read_header(path)
    require_task(path, about_task(header), env_id)
    entries = first_episodes(path, header, num)
    if failures := sum(not entry["success"] for entry in entries):
        log.warning("%s: %d of the first %d episodes do not succeed", path, failures, len(entries))
    with open_trajectories(path) as file:
        for entry in entries:
            group_of(file, entry)  # an episode that is missing is said before any is read
        for i in progress(range(len(entries))):
            entry = entries[i]
            yield _read_episode(file, entry, keys, path, header) | _outcomes(group_of(file, entry), outcomes)


def first_episodes(path: Path, header: dict[str, Any], num: int | None) -> list[dict[str, Any]]:
    """The first entries of episodes in a file's json.

    Args:
        path: The trajectory file.
        header: Its json.
        num: Number of episodes; all of them if None.

    Raises:
        DemonstrationError: The file has fewer episodes, or none.
    """
    held = header["episodes"]
    if not held:
        raise DemonstrationError(f"{path} holds no episode yet; record some with `manifeel record`")
    count = len(held) if num is None else num
    if not 0 < count <= len(held):
        raise DemonstrationError(f"{path} holds {len(held)} episodes, {count} are wanted; record more, or ask for fewer")
    return held[:count]


def observation_keys(path: Path) -> list[str]:
    """Keys of a file's observations that policies use: images, force fields, and the pose of the tool.

    Raises:
        DemonstrationError: The file lacks the pose of the tool, or holds no episode.
    """
    header = read_header(path)
    with open_trajectories(path) as file:
        group = group_of(file, first_episodes(path, header, None)[0])
        sensors = group.get("obs/sensor_data", {})
        keys = [
            f"sensor_data/{sensor}/{kind}" for sensor in sensors for kind in ("rgb", "force_field") if kind in sensors[sensor]
        ]
        if f"obs/{POSE}" not in group:
            held = "states and actions alone"
            if (mode := header["env_info"]["env_kwargs"].get("obs_mode", "none")) != "none":
                held = f"observations of obs_mode={mode!r}, in which the pose of the tool is not an array of its own"
            raise DemonstrationError(f"{path} holds {held}; `manifeel render-observations` makes a file with observations")
    return [*keys, POSE]


def observations_beside(path: Path, keys: list[str]) -> list[str]:
    """Names of the observations in a file that are not among these keys, in alphabetical order.

    Args:
        path: Trajectory file.
        keys: Keys from `observation_keys`.
    """
    found: list[str] = []

    def add(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and name not in keys:
            found.append(name)

    with open_trajectories(path) as file:
        group_of(file, read_header(path)["episodes"][0])["obs"].visititems(add)
    return sorted(found)


def require_same_form(path: Path, number: int, arrays: dict[str, np.ndarray], first: dict[str, np.ndarray]) -> None:
    """Check that an episode has the arrays of the first one: their names, their types, and their shapes at a step.

    Args:
        path: Trajectory file, for the message.
        number: Number of the episode, from 0.
        arrays: Arrays (T, ...) of the episode.
        first: Arrays of the first episode.

    Raises:
        DemonstrationError: It has others.
    """
    forms = [{name: (str(v.dtype), v.shape[1:]) for name, v in episode.items()} for episode in (first, arrays)]
    for name in [name for name in forms[0] | forms[1] if forms[0].get(name) != forms[1].get(name)]:
        expected, found = (f"{form[name][0]} {form[name][1]}" if name in form else "nothing" for form in forms)
        raise DemonstrationError(
            f"{path}: episode {number}, counted from 0, has {found} as {name!r}, and the first episode {expected}; a data set "
            "has one form: export files of the same sensors and control mode separately"
        )


def _outcomes(group: Any, names: tuple[str, ...]) -> Demonstration:
    """Arrays of an episode that have one number for each action, of those that the file has."""
    found = {name: group[name][()] for name in names if name in group}
    return {name: values for name, values in found.items() if values.shape == group["actions"].shape[:1]}


def _read_episode(file: Any, entry: dict[str, Any], keys: list[str], path: Path, header: dict) -> Demonstration:
    group = group_of(file, entry)
    missing = [key for key in keys if f"obs/{key}" not in group]
    if missing:
        mode = header["env_info"]["env_kwargs"].get("obs_mode")
        raise DemonstrationError(
            f"{path} was recorded with obs_mode={mode!r} and lacks {missing}; record it with an obs_mode, cameras and "
            "tactile_sensors that include them"
        )
    episode = dict(actions=actions_of(file, entry)) | {key: group[f"obs/{key}"][()] for key in keys}
    steps = len(episode["actions"])
    if wrong := [key for key in keys if episode[key].ndim < 2 or len(episode[key]) != steps + 1]:
        raise DemonstrationError(
            f"{path} has {steps} actions in traj_{entry['episode_id']}, and {wrong} of another length than {steps + 1}; record "
            "it again"
        )
    return episode


MANISKILL_H5 = DemonstrationFormat(
    "maniskill",
    matches=lambda path: not Path(path).is_dir(),
    count=count_episodes,
    read=read_trajectories,
    env_id=lambda path: task_of(read_header(path)),
    env_kwargs=lambda path: read_header(path)["env_info"]["env_kwargs"],
)
