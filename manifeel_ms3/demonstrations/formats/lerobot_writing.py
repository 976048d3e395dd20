"""Writing of LeRobot datasets (format 3.0): all images without loss, or the cameras' images as videos."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from manifeel_ms3.agents.panda_gelsight import ACTION_AXES, JOINT_ACTION_AXES
from manifeel_ms3.command_line import missing_extras_named
from manifeel_ms3.errors import UnknownNameError
from manifeel_ms3.files import write_json
from manifeel_ms3.tasks.obs_modes import PAD
from manifeel_ms3.tasks.registry import task_spec
from manifeel_ms3.tasks.visuotactile_env import CONTROL_FREQ

from .demonstration_format import DemonstrationError, Progress
from .lerobot_card import card
from .lerobot_layout import CARD, COUNTERS, DATA, INFO, ORIGIN, POSE_AXES, VIDEO, feature_name
from .lerobot_statistics import episode_statistics, joined_statistics
from .maniskill_h5 import about_task, observation_keys, read_header, read_trajectories, require_same_form, task_of

FILES_PER_CHUNK = 1000
"""Number of files in a folder, lerobot's default."""
DATA_FILE_MB, VIDEO_FILE_MB = 100, 200
"""Sizes in MB from which lerobot starts a new file, its defaults."""
IMAGE_AXES, FIELD_AXES = ["height", "width", "channels"], ["rows", "columns", "force"]
"""Names of the axes of an image and of a force field."""
CRF, KEYFRAME_EVERY = 18, 2
"""Constant rate factor of H.264, nearly without visible loss (FFmpeg's H.264 guide), and number of frames from one key frame to
the next, lerobot's default."""
OUTCOMES: dict[str, tuple[str, type]] = {"rewards": ("next.reward", np.float32), "success": ("next.success", np.bool_)}
"""Arrays of a trajectory file about what follows an action, with LeRobot's names and types."""


def write_lerobot(path: Path, folder: Path, progress: Progress = iter, videos: bool = False) -> None:
    """Write a trajectory file as a LeRobot dataset, with one data file for each episode.

    Args:
        path: Trajectory file.
        folder: Folder of the dataset; it is made.
        progress: Wraps the iteration over episodes, to show a progress bar.
        videos: Store the cameras' images as videos (H.264), which loses a little, instead of PNG. Touch is always PNG.

    Raises:
        DemonstrationError: The trajectory file is broken, or holds no observations; or videos of an odd size are requested.
        ManifeelError: The sensor is of a package that is not installed, or the arguments of the pads are not allowed.
        MissingExtraError: pyarrow or imageio is not installed.
    """
    pa, pq = pyarrow()
    header, keys = read_header(path), observation_keys(path)
    writer, entries, start, first = _Features(header, videos), [], 0, {}
    task = _instruction(header)
    for e, episode in enumerate(read_trajectories(path, keys, progress=progress, outcomes=tuple(OUTCOMES))):
        values = _features_of(episode, keys, e, start, writer.fps)
        first = first or {name: array[:1] for name, array in values.items()}
        require_same_form(path, e, values, first)
        writer.describe(values)
        place = dict(chunk_index=e // FILES_PER_CHUNK, file_index=e % FILES_PER_CHUNK)
        file = folder / DATA.format(**place)
        file.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table({name: _column(v) for name, v in values.items() if name not in writer.as_video}), file)
        for name in writer.as_video:
            _write_video(folder / VIDEO.format(video_key=name, **place), values[name], writer.fps)
        entries.append(_entry(e, start, values, place, task, writer))
        start = entries[-1]["dataset_to_index"]
    (folder / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(entries), folder / "meta/episodes/chunk-000/file-000.parquet")
    pq.write_table(_tasks(task), folder / "meta/tasks.parquet")
    write_json(folder / "meta/stats.json", {name: joined_statistics(name, entries) for name in writer.features})
    info = _info(writer, len(entries), start)
    (folder / CARD).write_text(card(header, keys, task, info), encoding="utf-8")
    write_json(folder / ORIGIN, about_task(header))
    write_json(folder / INFO, info)  # last: a folder without it is not a dataset


def pyarrow() -> tuple[Any, Any]:
    """The modules `pyarrow` and `pyarrow.parquet`.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    with missing_extras_named():
        import pyarrow
        import pyarrow.parquet
    return pyarrow, pyarrow.parquet


def _instruction(header: dict[str, Any]) -> str:
    """The sentence that tells a robot what to do; the id of a task that is not registered here, or has no sentence."""
    env_id = task_of(header)
    try:
        return task_spec(env_id).instruction_for(header["env_info"]["env_kwargs"]) or env_id
    except UnknownNameError:
        return env_id


def _control_freq(header: dict[str, Any]) -> int:
    """Control steps per second of a recording: that of all tasks, unless its arguments have another one."""
    return (header["env_info"]["env_kwargs"].get("sim_config") or {}).get("control_freq", CONTROL_FREQ)


class _Features:
    """The features of a dataset, as meta/info.json describes them.

    Args:
        header: The json beside the trajectory file.
        videos: Whether the cameras' images are stored as videos.
    """

    def __init__(self, header: dict[str, Any], videos: bool):
        modes = {episode.get("control_mode") for episode in header["episodes"]}
        self._action_axes = (ACTION_AXES | JOINT_ACTION_AXES).get(str(modes.pop())) if len(modes) == 1 else None
        self._videos = videos
        self.fps = _control_freq(header)
        """Frames per second."""
        self.features: dict[str, dict[str, Any]] = {}
        self.as_video: list[str] = []
        """Features that are stored as videos."""

    def describe(self, values: dict[str, np.ndarray]) -> None:
        """Derive the features from the arrays of the first episode.

        Raises:
            DemonstrationError: An image of an odd size cannot become a video.
        """
        if self.features:
            return
        if self._videos:
            images = [name for name, v in values.items() if v.dtype == np.uint8]
            self.as_video = [name for name in images if not name.startswith(f"observation.images.{PAD}")]
        if odd := [name for name in self.as_video if any(size % 2 for size in values[name].shape[1:3])]:
            raise DemonstrationError(f"{odd} have an odd width or height, which H.264 does not take; leave --videos out")
        self.features = {name: self._described(name, array) for name, array in values.items()}

    def _described(self, name: str, values: np.ndarray) -> dict[str, Any]:
        shape: list[int] = list(values.shape[1:]) or [1]
        if name in self.as_video:
            return dict(dtype="video", shape=shape, names=IMAGE_AXES, info=_video_info(shape, self.fps))
        if values.dtype == np.uint8:
            return dict(dtype="image", shape=shape, names=IMAGE_AXES)
        return dict(dtype=str(values.dtype), shape=shape, names=self._axes(name, shape))

    def _axes(self, name: str, shape: list[int]) -> list[str] | None:
        if name == "observation.state":
            return POSE_AXES
        if name == "action":
            axes = self._action_axes
            return list(axes) if axes and len(axes) == shape[0] else None
        return FIELD_AXES if len(shape) == 3 else None


def _video_info(shape: list[int], fps: int) -> dict[str, Any]:
    """Description of a video by the names that lerobot gives its parts."""
    size = {"video.height": shape[0], "video.width": shape[1], "video.channels": shape[2], "video.fps": fps}
    form = {"video.codec": "h264", "video.pix_fmt": "yuv420p", "video.is_depth_map": False, "has_audio": False}
    return size | form


def _features_of(episode: dict[str, np.ndarray], keys: list[str], number: int, start: int, fps: int) -> dict[str, np.ndarray]:
    """The features of an episode, (T, ...) by their names; `start` is the number of frames before it."""
    length = len(episode["actions"])
    frame = np.arange(length)
    values = {feature_name(key): episode[key][:length] for key in keys} | dict(action=episode["actions"])
    values |= {name: episode[array].astype(kind) for array, (name, kind) in OUTCOMES.items() if array in episode}
    values["next.done"] = frame == length - 1
    values["timestamp"] = (frame / fps).astype(np.float32)
    return values | dict(zip(COUNTERS, (frame, np.full(length, number), start + frame, np.zeros(length, int)), strict=True))


def _entry(
    number: int, start: int, values: dict[str, np.ndarray], place: dict[str, int], task: str, writer: _Features
) -> dict[str, Any]:
    """An episode's entry in meta/episodes."""
    length = len(values["action"])
    times = dict(from_timestamp=0.0, to_timestamp=length / writer.fps)  # each episode has a video file of its own
    return (
        dict(episode_index=number, tasks=[task], length=length)
        | {f"data/{name}": value for name, value in place.items()}
        | {f"videos/{video}/{name}": value for video in writer.as_video for name, value in (place | times).items()}
        | dict(dataset_from_index=start, dataset_to_index=start + length)
        | {f"stats/{name}/{what}": value for name, v in values.items() for what, value in episode_statistics(v).items()}
        | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
    )


def _info(described: _Features, num_episodes: int, num_frames: int) -> dict[str, Any]:
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
        fps=described.fps,
        splits=dict(train=f"0:{num_episodes}"),
        data_path=DATA,
        video_path=VIDEO if described.as_video else None,
        features=described.features,
    )


def _column(values: np.ndarray) -> Any:
    """A feature as a column of a table: images as PNG, arrays as nested lists."""
    pa, _ = pyarrow()
    if values.dtype == np.uint8:
        images = [dict(bytes=cv2.imencode(".png", image[..., ::-1])[1].tobytes(), path=None) for image in values]
        return pa.array(images, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
    kind = pa.from_numpy_dtype(values.dtype)
    if values.ndim == 2:
        kind = pa.list_(kind, values.shape[1])
    for _ in range(values.ndim - 1 if values.ndim > 2 else 0):
        kind = pa.list_(kind)
    return pa.array(values.tolist(), kind)


def _write_video(path: Path, images: np.ndarray, fps: int) -> None:
    with missing_extras_named():
        import imageio.v2 as imageio
    path.parent.mkdir(parents=True, exist_ok=True)
    writer: Any  # the stubs of imageio do not know `append_data`
    options = ["-crf", str(CRF), "-g", str(KEYFRAME_EVERY)]
    with imageio.get_writer(
        path, fps=fps, codec="libx264", quality=None, pixelformat="yuv420p", macro_block_size=2, output_params=options
    ) as writer:
        for image in images:
            writer.append_data(image)


def _tasks(task: str) -> Any:
    """The content of meta/tasks.parquet: a pandas table whose index is the sentence of the task."""
    pa, _ = pyarrow()
    column = dict(name="task_index", field_name="task_index", pandas_type="int64", numpy_type="int64", metadata=None)
    name = "__index_level_0__"
    index = dict(name=None, field_name=name, pandas_type="unicode", numpy_type="object", metadata=None)
    described = dict(index_columns=[name], column_indexes=[], columns=[column, index], pandas_version="2.0.0")
    return pa.table({"task_index": [0], name: [task]}).replace_schema_metadata({"pandas": json.dumps(described)})
