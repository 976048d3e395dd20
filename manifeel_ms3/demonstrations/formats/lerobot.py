"""LeRobot datasets (format 3.0): read as demonstrations, and written.

Features are named after what they hold: `observation.images.wrist`, `observation.images.tactile_right` (TacRGB),
`observation.force_field.tactile_right` (N per taxel), `observation.state` (pose of the tool in the base frame, m and wxyz), and
`action`.

The files are written here and not by lerobot's own library, because lerobot 0.4.4 cannot be installed beside the versions that
this package is tested with. It requires torch < 2.11 with torchvision and torchcodec, opencv-python-headless < 4.13, packaging
< 26 and diffusers < 0.36; the tests run with torch 2.13, beside whose CPU build torchvision cannot be imported, OpenCV 5,
packaging 26 and diffusers 0.42. The tests read datasets that lerobot 0.4.4 has written, and let its reader, where it is
installed, read what is written here.
"""

import json
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
from manifeel_ms3.files import read_json, write_json
from manifeel_ms3.tasks.visuotactile_env import CONTROL_FREQ

from .demonstration_format import MAX_COMPRESSION, DemonstrationError, DemonstrationFormat, Progress
from .lerobot_statistics import episode_statistics, joined_statistics
from .maniskill_h5 import each_demonstration, observation_keys, read_header
from .own_files import broken_if_fails, stored_bytes

INFO = "meta/info.json"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
"""Paths of the files in LeRobot's layout 3.0. The layout that a data set describes is compared and never filled in, because a
description can name any file."""
MP4 = b"ftyp"
"""Bytes 4 to 8 of an mp4 file (ISO 14496-12, section 4.3); a playlist of that name would make ffmpeg read other files."""
PNG = b"\x89PNG\r\n\x1a\n"
"""First bytes of a PNG file (W3C PNG, section 5.2); width and height follow as big-endian numbers in bytes 16 to 24."""
WORD = 8
"""Largest number of bytes of a number in a table."""
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
"""Json schema of the fields that are read from meta/info.json."""
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
"""Features that number frames, episodes and tasks; every LeRobot dataset has them."""
FILES_PER_CHUNK = 1000
"""Number of files in a folder, lerobot's default."""
DATA_FILE_MB, VIDEO_FILE_MB = 100, 200
"""Sizes in MB from which lerobot starts a new file, its defaults."""


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return (Path(path) / INFO).is_file()


def feature_name(key: str) -> str:
    """LeRobot's name of an observation, such as "observation.images.wrist" for "sensor_data/wrist/rgb"."""
    if key == "extra/tcp_pose":
        return "observation.state"
    _, sensor, kind = key.split("/")
    return f"observation.{'images' if kind == 'rgb' else kind}.{sensor}"


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


# -------------------------------------------------------------------- reading


def read_lerobot(
    folder: Path, keys: list[str], num: int | None = None, progress: Progress = iter, env_id: str | None = None
) -> list[dict[str, np.ndarray]]:
    """The first episodes of a dataset, as `read_demonstrations` returns them.

    LeRobot does not hold the observation after the last action: the last observation stands there a second time.

    Args:
        folder: Folder of the dataset.
        keys: Observations to read.
        num: Number of episodes; all of them if not given.
        progress: Wraps the iteration over episodes, to show a progress bar.
        env_id: Ignored: datasets of other sources do not name tasks of this package.

    Raises:
        DemonstrationError: The dataset is broken, or lacks a feature.
        MissingExtraError: pyarrow or imageio is not installed.
    """
    info = read_info(folder)
    names = {key: feature_name(key) for key in keys}
    if missing := [name for name in (*names.values(), "action") if name not in info["features"]]:
        raise DemonstrationError(f"{folder} lacks {missing}; it holds {sorted(info['features'])}")
    folder, files = Path(folder), stored_bytes(folder)
    videos = {name: _Video(folder, info, name) for name in names.values() if info["features"][name]["dtype"] == "video"}
    entries = _entries(folder, files, list(videos))
    columns = ["index", "action", *(name for name in names.values() if name not in videos)]
    data = _table(folder, files, "data", columns).sort_by("index")
    count = info["total_episodes"] if num is None else num
    if not 0 < count <= len(entries):
        raise DemonstrationError(f"{folder} holds {len(entries)} episodes, {count} are wanted; ask for fewer")
    episodes = []
    for i in progress(range(count)):
        first, length = entries[i]["dataset_from_index"], entries[i]["length"]
        if not (first >= 0 and 0 < length <= data.num_rows - first):
            raise DemonstrationError(
                f"{folder}: episode {i} has {length} frames from {first} on, of {data.num_rows}; export it again"
            )
        rows = data.slice(first, length)
        episode = {}
        for key, name in names.items():
            values = videos[name].frames(entries[i]) if name in videos else _values(folder, info, name, rows)
            episode[key] = np.concatenate([values, values[-1:]])
        episodes.append(episode | dict(actions=_numbers(folder, info, "action", rows)))
    return episodes


def _entries(folder: Path, files: dict[Path, int], videos: list[str]) -> list[dict[str, Any]]:
    """The entries of meta/episodes in order, as far as they are read.

    Raises:
        DemonstrationError: They are broken.
    """
    parts = ["chunk_index", "file_index", "from_timestamp"]
    numbers = ["episode_index", "dataset_from_index", "length", *(f"videos/{name}/{part}" for name in videos for part in parts)]
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
    pa, pq = _pyarrow()
    tables = []
    with broken_if_fails(folder, part):
        for path in sorted((folder / part).glob("chunk-*/file-*.parquet")):
            with pq.ParquetFile(path) as file:
                about = file.metadata
                held = sum(
                    about.row_group(g).column(c).num_values
                    for g in range(about.num_row_groups)
                    for c in range(about.num_columns)
                )
                if max(held, about.num_rows) * WORD > MAX_COMPRESSION * files[path]:
                    raise DemonstrationError(f"{path} declares {held} numbers in {files[path]} bytes; get it again")
                if missing := sorted(set(columns) - set(file.schema_arrow.names)):
                    raise DemonstrationError(f"{path} lacks {missing}; export the dataset again")
                tables.append(file.read(columns=columns))
        return pa.concat_tables(tables)


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
        place = {part: entry[f"videos/{self._name}/{part}"] for part in ("chunk_index", "file_index")}
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


# -------------------------------------------------------------------- writing


def write_lerobot(path: Path, folder: Path, progress: Progress = iter) -> None:
    """Write a trajectory file as a LeRobot dataset, with lossless images and one data file for each episode.

    Args:
        path: Trajectory file.
        folder: Folder of the dataset; it is made.
        progress: Wraps the iteration over episodes, to show a progress bar.

    Raises:
        DemonstrationError: The trajectory file is broken, or holds no observations.
        MissingExtraError: pyarrow is not installed.
    """
    pa, pq = _pyarrow()
    task = read_header(path)["env_info"]["env_id"].rpartition(":")[2]
    keys, features, entries, start = observation_keys(path), {}, [], 0
    for e, episode in enumerate(each_demonstration(path, keys, progress)):
        values = _features_of(episode, keys, e, start)
        features = features or {name: _described(array) for name, array in values.items()}
        place = dict(chunk_index=e // FILES_PER_CHUNK, file_index=e % FILES_PER_CHUNK)
        file = folder / DATA.format(**place)
        file.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table({name: _column(array) for name, array in values.items()}), file)
        entries.append(_entry(e, task, start, values, place))
        start = entries[-1]["dataset_to_index"]
    (folder / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(entries), folder / "meta/episodes/chunk-000/file-000.parquet")
    pq.write_table(_tasks(task), folder / "meta/tasks.parquet")
    write_json(folder / "meta/stats.json", {name: joined_statistics(name, entries) for name in features})
    write_json(folder / INFO, _info(features, len(entries), start))  # last: a folder without it is not a dataset


def _features_of(episode: dict[str, np.ndarray], keys: list[str], number: int, start: int) -> dict[str, np.ndarray]:
    """The features of an episode, (T, ...) by their names; `start` is the number of frames before it."""
    length = len(episode["actions"])
    frame = np.arange(length)
    values = {feature_name(key): episode[key][:length] for key in keys} | dict(action=episode["actions"])
    values["timestamp"] = (frame / CONTROL_FREQ).astype(np.float32)
    return values | dict(zip(COUNTERS, (frame, np.full(length, number), start + frame, np.zeros(length, int)), strict=True))


def _entry(number: int, task: str, start: int, values: dict[str, np.ndarray], place: dict[str, int]) -> dict[str, Any]:
    """An episode's entry in meta/episodes."""
    length = len(values["action"])
    return (
        dict(episode_index=number, tasks=[task], length=length)
        | {f"data/{name}": value for name, value in place.items()}
        | dict(dataset_from_index=start, dataset_to_index=start + length)
        | {f"stats/{name}/{what}": value for name, v in values.items() for what, value in episode_statistics(v).items()}
        | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
    )


def _info(features: dict[str, Any], num_episodes: int, num_frames: int) -> dict[str, Any]:
    """The content of meta/info.json."""
    return dict(
        codebase_version="v3.0",
        robot_type="panda_gelsight",
        total_episodes=num_episodes,
        total_frames=num_frames,
        total_tasks=1,
        chunks_size=FILES_PER_CHUNK,
        data_files_size_in_mb=DATA_FILE_MB,
        video_files_size_in_mb=VIDEO_FILE_MB,
        fps=CONTROL_FREQ,
        splits=dict(train=f"0:{num_episodes}"),
        data_path=DATA,
        video_path=None,
        features=features,
    )


def _pyarrow() -> tuple[Any, Any]:
    with missing_extras_named():
        import pyarrow
        import pyarrow.parquet
    return pyarrow, pyarrow.parquet


def _described(values: np.ndarray) -> dict[str, Any]:
    """A feature's entry in meta/info.json."""
    if values.dtype == np.uint8:
        return dict(dtype="image", shape=list(values.shape[1:]), names=["height", "width", "channels"])
    return dict(dtype=str(values.dtype), shape=list(values.shape[1:] or (1,)), names=None)


def _column(values: np.ndarray) -> Any:
    """A feature as a column of a table: images as PNG, arrays as nested lists."""
    pa, _ = _pyarrow()
    if values.dtype == np.uint8:
        images = [dict(bytes=cv2.imencode(".png", image[..., ::-1])[1].tobytes(), path=None) for image in values]
        return pa.array(images, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
    kind = pa.from_numpy_dtype(values.dtype)
    if values.ndim == 2:
        kind = pa.list_(kind, values.shape[1])
    for _ in range(values.ndim - 1 if values.ndim > 2 else 0):
        kind = pa.list_(kind)
    return pa.array(values.tolist(), kind)


def _tasks(task: str) -> Any:
    """The content of meta/tasks.parquet: a pandas table whose index is the name of the task."""
    pa, _ = _pyarrow()
    column = dict(name="task_index", field_name="task_index", pandas_type="int64", numpy_type="int64", metadata=None)
    name = "__index_level_0__"
    index = dict(name=None, field_name=name, pandas_type="unicode", numpy_type="object", metadata=None)
    described = dict(index_columns=[name], column_indexes=[], columns=[column, index], pandas_version="2.0.0")
    return pa.table({"task_index": [0], name: [task]}).replace_schema_metadata({"pandas": json.dumps(described)})


LEROBOT = DemonstrationFormat("lerobot", is_lerobot, count_episodes, read_lerobot, write_lerobot)
