"""LeRobot datasets (format 3.0): read as demonstrations, and written.

Features are named after what they hold: `observation.images.wrist`, `observation.images.tactile_right` (TacRGB),
`observation.tactile.right.force_field` (N per taxel), `observation.state` (pose of the tool in the base frame, m and wxyz),
`action`, `next.reward`, `next.success` and `next.done`.

The files are written here and not by lerobot's own library, because lerobot 0.4.4 cannot be installed beside the versions that
this package is locked to. It requires torch < 2.11 with torchvision and torchcodec, opencv-python-headless < 4.13, packaging
< 26 and diffusers < 0.36. This package is locked to torch 2.13, OpenCV 5, packaging 26 and diffusers 0.42, and torchvision
cannot be imported beside the CPU build of torch 2.13. With torch 2.10 the two packages work together. The tests read datasets
that lerobot 0.4.4 has written; where lerobot is installed, its reader also reads what is written here.
"""

import logging
import math
from collections.abc import Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from manifeel_ms3.command_line import missing_extras_named
from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.files import read_json
from manifeel_ms3.tasks.obs_modes import POSE
from manifeel_ms3.tasks.visuotactile_env import CONTROL_FREQ

from .demonstration_format import MAX_COMPRESSION, Demonstration, DemonstrationError, DemonstrationFormat, Progress
from .folder_checks import broken_if_fails, read_origin, require_task, stored_bytes
from .lerobot_layout import DATA, INFO, ORIGIN, POSE_AXES, VIDEO, earlier_feature_name, feature_name
from .lerobot_writing import pyarrow, write_lerobot

log = logging.getLogger(__name__)
PLACE = ("chunk_index", "file_index")
"""Numbers that name a file of the layout."""
MP4 = b"ftyp"
"""Bytes 4 to 8 of an mp4 file (ISO 14496-12, section 4.3); a playlist of that name would make ffmpeg read other files."""
PNG = b"\x89PNG\r\n\x1a\n"
"""First bytes of a PNG file (W3C PNG, section 5.2); width and height follow as big-endian numbers in bytes 16 to 24."""
WORD = 8
"""Largest number of bytes of one number in a table."""
DESCRIPTION = {
    "type": "object",
    "required": ["codebase_version"],
    "if": {"properties": {"codebase_version": {"type": "string", "pattern": r"^v3\."}}},
    "then": {
        "required": ["total_episodes", "features", "fps"],
        "properties": {
            "total_episodes": {"type": "integer", "minimum": 0, "maximum": 2**31},
            "fps": {"type": "number", "exclusiveMinimum": 0, "maximum": 1e6},
            "video_path": {"enum": [VIDEO, None]},
            "features": {
                "type": "object",
                "additionalProperties": {
                    "type": "object",
                    "required": ["dtype", "shape"],
                    "properties": {
                        "dtype": {"type": "string"},
                        "shape": {"type": "array", "items": {"type": "integer", "minimum": 1, "maximum": 2**16}},
                    },
                },
            },
        },
    },
}
"""Json schema of the fields that are read from meta/info.json; its upper bounds are far above those of any dataset."""
ABOUT = {
    "type": "object",
    "required": ["env_id", "env_kwargs"],
    "properties": {"env_id": {"type": "string"}, "env_kwargs": {"type": "object"}, "revision": {"type": "integer"}},
}
"""Json schema of meta/manifeel.json."""


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return (Path(path) / INFO).is_file()


def count_episodes(folder: Path) -> int:
    """Number of episodes in a dataset."""
    return read_info(folder)["total_episodes"]


def read_info(folder: Path) -> dict[str, Any]:
    """The content of meta/info.json.

    Raises:
        DemonstrationError: The file is broken, or the dataset is of another version.
    """
    try:
        info = read_json(Path(folder) / INFO, DESCRIPTION, "the description of a LeRobot dataset")
    except InvalidFileError as error:
        raise DemonstrationError(str(error)) from error
    if not str(info.get("codebase_version")).startswith("v3."):
        raise DemonstrationError(
            f"{folder} is a LeRobot dataset of version {info.get('codebase_version')}, v3.0 is read here; convert it with "
            "lerobot's convert_dataset_v21_to_v30"
        )
    return info


def recorded_arguments(folder: Path) -> dict[str, Any] | None:
    """Arguments of the task with which a dataset was recorded; None if it was not exported by this package.

    Raises:
        DemonstrationError: The file that names them is broken.
    """
    return _origin(folder).get("env_kwargs")


def _origin(folder: Path) -> dict[str, Any]:
    return read_origin(Path(folder) / ORIGIN, ABOUT, "the origin of a LeRobot dataset", "export the dataset again")


def read_lerobot(
    folder: Path, keys: list[str], num: int | None = None, progress: Progress = iter, env_id: str | None = None
) -> Iterator[Demonstration]:
    """The first episodes of a dataset, as `read_demonstrations` returns them, one at a time.

    LeRobot does not hold the observation after the last action: the last observation stands there a second time.

    Args:
        folder: Folder of the dataset.
        keys: Observations to read.
        num: Number of episodes; all of them if not given.
        progress: Wraps the iteration over episodes, to show a progress bar.
        env_id: Id of the task that the episodes must be of, if the dataset names its task.

    Raises:
        DemonstrationError: The dataset is broken, is of another task, or lacks a feature.
        MissingExtraError: pyarrow or imageio is not installed.
    """
    info = read_info(folder)
    require_task(folder, origin := _origin(folder), env_id)
    if not origin and info["fps"] != CONTROL_FREQ:
        log.warning("%s has %g frames per second; tasks here act %d times per second", folder, info["fps"], CONTROL_FREQ)
    names = {key: next((n for n in _names(key) if n in info["features"]), feature_name(key)) for key in keys}
    if missing := [name for name in (*names.values(), "action") if name not in info["features"]]:
        raise DemonstrationError(f"{folder} lacks {missing}; it holds {sorted(info['features'])}")
    _require_pose(folder, info, [name for key, name in names.items() if key == POSE])
    folder, files = Path(folder), stored_bytes(folder)
    videos = {name: _Video(folder, info, name) for name in names.values() if info["features"][name]["dtype"] == "video"}
    entries = _entries(folder, files, list(videos))
    data = _Data(folder, files, ["index", "action", *(name for name in names.values() if name not in videos)])
    count = info["total_episodes"] if num is None else num
    if not 0 < count <= len(entries):
        raise DemonstrationError(f"{folder} holds {len(entries)} episodes, {count} are wanted; ask for fewer")
    for i in progress(range(count)):
        rows = data.rows(entries[i])
        episode = {}
        for key, name in names.items():
            values = videos[name].frames(entries[i]) if name in videos else _values(folder, info, name, rows)
            episode[key] = np.concatenate([values, values[-1:]])
        yield episode | dict(actions=_numbers(folder, info, "action", rows))


def _require_pose(folder: Path, info: dict[str, Any], names: list[str]) -> None:
    """Check that features whose components have names are poses of the tool, and not, for example, positions of seven joints.

    Raises:
        DemonstrationError: A feature has other components.
    """
    for name in names:
        components = info["features"][name].get("names")
        if isinstance(components, dict) and len(components) == 1:  # lerobot also writes {"motors": [...]}
            (components,) = components.values()
        if components is not None and components != POSE_AXES:
            raise DemonstrationError(
                f"{folder}: {name} holds {components}, and policies here take the pose of the tool, {POSE_AXES}; write a "
                "dataset that has it"
            )


def _names(key: str) -> tuple[str, str]:
    return feature_name(key), earlier_feature_name(key)


def _entries(folder: Path, files: dict[Path, int], videos: list[str]) -> list[dict[str, Any]]:
    """The entries of meta/episodes in order, with the columns that are read here.

    Raises:
        DemonstrationError: The entries are broken.
    """
    parts = [*PLACE, "from_timestamp"]
    numbers = ["episode_index", "dataset_from_index", "length", *(f"data/{part}" for part in PLACE)]
    numbers += [f"videos/{name}/{part}" for name in videos for part in parts]
    entries = _table(folder, files, "meta/episodes", numbers).sort_by("episode_index").to_pylist()
    for entry in entries:
        for name, value in entry.items():
            wanted = (int, float) if name.endswith("from_timestamp") else int
            if not isinstance(value, wanted) or not 0 <= value < math.inf:
                raise DemonstrationError(f"{folder}/meta/episodes has {name}={value!r}, not a number; export the dataset again")
    return entries


def _table(folder: Path, files: dict[Path, int], part: str, columns: list[str]) -> Any:
    """Columns of the tables in a part of the folder, one after the other.

    Raises:
        DemonstrationError: A table is broken, lacks a column, or declares more numbers than it can hold.
    """
    pa, _ = pyarrow()
    with broken_if_fails(folder, part):
        paths = sorted((folder / part).glob("chunk-*/file-*.parquet"))
        return pa.concat_tables(_read_table(path, files[path], columns) for path in paths)


def _read_table(path: Path, stored: int, columns: list[str]) -> Any:
    """Columns of one table, whose file has this number of bytes; the errors are those of `_table` and of pyarrow."""
    _, pq = pyarrow()
    with pq.ParquetFile(path) as file:
        about = file.metadata
        groups, parts = range(about.num_row_groups), range(about.num_columns)
        held = sum(about.row_group(g).column(c).num_values for g in groups for c in parts)
        if max(held, about.num_rows) * WORD > MAX_COMPRESSION * stored:
            raise DemonstrationError(f"{path} declares {held} numbers in {stored} bytes; get it again")
        if missing := sorted(set(columns) - set(file.schema_arrow.names)):
            raise DemonstrationError(f"{path} lacks {missing}; export the dataset again")
        return file.read(columns=columns)


class _Data:
    """The rows of the episodes, of which each lies in one data file. One file is in memory at a time.

    Args:
        folder: Folder of the dataset.
        files: Sizes of its files in bytes, by their paths.
        columns: Features to read, and "index".
    """

    def __init__(self, folder: Path, files: dict[Path, int], columns: list[str]):
        self._folder, self._files, self._columns = folder, files, columns
        self._path: Path | None = None
        self._table: Any = None

    def rows(self, entry: dict[str, Any]) -> Any:
        """The rows of the episode that has this entry in meta/episodes, in their order.

        Raises:
            DemonstrationError: The data file is missing or broken, or lacks rows of the episode.
        """
        path = self._folder / DATA.format(**{part: entry[f"data/{part}"] for part in PLACE})
        first, length = entry["dataset_from_index"], entry["length"]
        with broken_if_fails(self._folder, f"in {path.relative_to(self._folder)}, the data"):
            if path != self._path:
                self._table = None  # before the next one is read
                self._path, self._table = path, _read_table(path, self._files[path], self._columns)
            index = np.asarray(self._table["index"])
            places = np.flatnonzero((index >= first) & (index < first + length))
            places = places[np.argsort(index[places])]
            if length == 0 or not np.array_equal(index[places], np.arange(first, first + length)):
                raise DemonstrationError(
                    f"{self._folder}: episode {entry['episode_index']} has {length} frames from {first} on, of which "
                    f"{path.name} holds {len(places)}; export it again"
                )
            rising = np.array_equal(places, np.arange(places[0], places[0] + length))
            return self._table.slice(places[0], length) if rising else self._table.take(places)


def _values(folder: Path, info: dict, name: str, rows: Any) -> np.ndarray:
    """Values (T, ...) of a feature that is not a video."""
    if info["features"][name]["dtype"] != "image":
        return _numbers(folder, info, name, rows)
    with broken_if_fails(folder, name):
        return np.stack([_decoded(image["bytes"], info["features"][name]["shape"]) for image in rows[name].to_pylist()])


def _numbers(folder: Path, info: dict, name: str, rows: Any) -> np.ndarray:
    with broken_if_fails(folder, name):
        return np.array(rows[name].to_pylist(), np.float32).reshape(len(rows), *info["features"][name]["shape"])


def _decoded(png: bytes, shape: list[int]) -> np.ndarray:
    """The image of a PNG file, once its header has been checked."""
    size = [int.from_bytes(png[at : at + 4], "big") for at in (20, 16)]
    if png[: len(PNG)] != PNG or size not in (shape[:2], shape[1:]) or math.prod(size) > MAX_COMPRESSION * len(png):
        raise ValueError(f"an image is not a PNG of the size {shape}")
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError("an image cannot be decoded")
    return image[..., ::-1]


class _Video:
    """A feature that is stored as video, with several episodes in a file; each file is decoded once, from its start on.

    Args:
        folder: Folder of the dataset.
        info: Content of meta/info.json.
        name: Name of the feature.
    """

    def __init__(self, folder: Path, info: dict[str, Any], name: str):
        self._folder, self._info, self._name = Path(folder), info, name
        self._path: Path | None = None
        self._next = 0
        self._frames: Iterator[np.ndarray] = iter(())

    def frames(self, entry: dict[str, Any]) -> np.ndarray:
        """Frames uint8 (T, H, W, 3) of the episode that has this entry in meta/episodes.

        Raises:
            DemonstrationError: The video is missing or broken, or ends before the episode does.
        """
        place = {part: entry[f"videos/{self._name}/{part}"] for part in PLACE}
        path = self._folder / VIDEO.format(video_key=self._name, **place)
        first, length = round(entry[f"videos/{self._name}/from_timestamp"] * self._info["fps"]), entry["length"]
        with broken_if_fails(self._folder, f"the video {path.relative_to(self._folder)}"):
            if path != self._path or first < self._next:
                self._path, self._next, self._frames = path, 0, _decode(path, self._info["features"][self._name]["shape"])
            frames = list(islice(self._frames, first - self._next, first - self._next + length))
            if len(frames) < length:
                raise ValueError("it ends too early")
            self._next = first + length
            return np.stack(frames)


def _decode(path: Path, shape: list[int]) -> Iterator[np.ndarray]:
    """The frames of a video file, one after the other, once its kind and size have been checked."""
    with missing_extras_named():
        import imageio.v2 as imageio
    with path.open("rb") as file:
        if file.read(8)[4:] != MP4:
            raise ValueError("it is not an mp4 file")
    with closing(imageio.get_reader(path)) as reader:
        size = list(reader.get_meta_data()["size"][::-1])
        if size not in (shape[:2], shape[1:]):
            raise ValueError(f"its frames have the size {size}, the dataset says {shape}")
        yield from reader.iter_data()


LEROBOT = DemonstrationFormat(
    "lerobot",
    is_lerobot,
    count_episodes,
    read_lerobot,
    write_lerobot,
    recorded_arguments,
    lambda folder: _origin(folder).get("env_id"),
)
