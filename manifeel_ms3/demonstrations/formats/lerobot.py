"""LeRobot datasets (format 3.0): read as demonstrations, and written.

Features are named after what they hold: `observation.images.wrist`, `observation.images.tactile_right` (TacRGB),
`observation.force_field.tactile_right` (N per taxel), `observation.state` (the tool's pose in the base frame: m and wxyz), and
`action`.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from manifeel_ms3.tasks.visuotactile_env import CONTROL_FREQ

from .maniskill_h5 import DemonstrationError, each_demonstration, observed, read_header, write_json

INFO = "meta/info.json"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
FPS = CONTROL_FREQ


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return (Path(path) / INFO).is_file()


def feature_name(key: str) -> str:
    """LeRobot's name of one of our observations ("sensor_data/wrist/rgb")."""
    if key == "extra/tcp_pose":
        return "observation.state"
    _, sensor, what = key.split("/")
    return f"observation.{'images' if what == 'rgb' else what}.{sensor}"


def count_episodes(folder: Path) -> int:
    return read_info(folder)["total_episodes"]


def read_info(folder: Path) -> dict[str, Any]:
    """meta/info.json.

    Raises:
        DemonstrationError: it is broken, or of another version.
    """
    path = Path(folder) / INFO
    try:
        info = json.loads(path.read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise DemonstrationError(f"{path} cannot be read ({error}); the dataset is broken, export it again") from error
    if not str(info.get("codebase_version")).startswith("v3."):
        raise DemonstrationError(
            f"{folder} is a LeRobot dataset of version {info.get('codebase_version')}, v3.0 is read here; convert it with "
            "lerobot's convert_dataset_v21_to_v30"
        )
    return info


def read_lerobot(folder: Path, keys: list[str], num: int, progress: Callable = iter) -> list[dict[str, np.ndarray]]:
    """The first `num` episodes, as `read_demonstrations` gives them; the observation after the last action, which LeRobot does
    not hold, is the last one again.

    Raises:
        DemonstrationError: the dataset is broken, or lacks a feature.
        ModuleNotFoundError: the extra is not installed.
    """
    info = read_info(folder)
    names = {key: feature_name(key) for key in keys}
    if missing := [name for name in (*names.values(), "action") if name not in info["features"]]:
        raise DemonstrationError(f"{folder} lacks {missing}; it holds {sorted(info['features'])}")
    episodes = _table(folder, "meta/episodes").sort_by("episode_index")
    data = _table(folder, "data").sort_by("index")
    read = []
    for i in progress(range(num)):
        meta = {name: episodes[name][i].as_py() for name in episodes.column_names if not name.startswith("stats/")}
        rows = data.slice(meta["dataset_from_index"], meta["length"])
        episode = {key: _feature(folder, info, name, rows, meta) for key, name in names.items()}
        episode = {key: np.concatenate([values, values[-1:]]) for key, values in episode.items()}
        read.append(episode | dict(actions=_numbers(rows["action"], info["features"]["action"]["shape"])))
    return read


def _table(folder: Path, part: str) -> Any:
    pa, pq = _pyarrow()
    files = sorted((Path(folder) / part).glob("chunk-*/file-*.parquet"))
    try:
        return pa.concat_tables([pq.read_table(file) for file in files])
    except (pa.ArrowException, OSError, ValueError) as error:
        raise DemonstrationError(f"{folder}/{part} cannot be read ({error}); the dataset is broken, export it again") from error


def _feature(folder: Path, info: dict, name: str, rows: Any, meta: dict) -> np.ndarray:
    feature = info["features"][name]
    if feature["dtype"] == "image":
        return np.stack([_decoded(picture["bytes"], folder, name) for picture in rows[name].to_pylist()])
    if feature["dtype"] == "video":
        return _video(folder, info, name, meta)
    return _numbers(rows[name], feature["shape"])


def _numbers(column: Any, shape: list[int]) -> np.ndarray:
    return np.array(column.to_pylist(), np.float32).reshape(-1, *shape)


def _decoded(png: bytes, folder: Path, name: str) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise DemonstrationError(f"{folder}: a picture of {name} cannot be decoded; the dataset is broken, export it again")
    return picture[..., ::-1]


def _video(folder: Path, info: dict, name: str, meta: dict) -> np.ndarray:
    import imageio.v2 as imageio

    place = {part: meta[f"videos/{name}/{part}"] for part in ("chunk_index", "file_index", "from_timestamp")}
    path = Path(folder) / info["video_path"].format(
        video_key=name, chunk_index=place["chunk_index"], file_index=place["file_index"]
    )
    first = round(place["from_timestamp"] * info["fps"])
    try:
        with imageio.get_reader(path) as reader:
            frames = [frame for k, frame in enumerate(reader) if first <= k < first + meta["length"]]
        return np.stack(frames)
    except (OSError, ValueError) as error:
        raise DemonstrationError(f"{path} cannot be read as a video ({error}); export the dataset again") from error


# -------------------------------------------------------------------- writing

COUNTED = ("frame_index", "episode_index", "index", "task_index")
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
PER_CHUNK = 1000  # files


def write_lerobot(path: Path, folder: Path, progress: Callable = iter) -> None:
    """Write a trajectory file as a LeRobot dataset: pictures losslessly, a data file an episode.

    Raises:
        DemonstrationError: the file is broken, or holds no observations.
        ModuleNotFoundError: the extra is not installed.
    """
    pa, pq = _pyarrow()
    task = read_header(path)["env_info"]["env_id"].rpartition(":")[2]
    keys, start, features, index = observed(path), 0, {}, []
    for e, episode in enumerate(each_demonstration(path, keys, progress)):
        length = len(episode["actions"])
        frames = {feature_name(key): episode[key][:length] for key in keys} | dict(action=episode["actions"])
        frame = np.arange(length)
        frames["timestamp"] = (frame / FPS).astype(np.float32)
        frames |= zip(COUNTED, (frame, np.full(length, e), start + frame, np.zeros(length, int)), strict=True)
        features = features or {name: _described(values) for name, values in frames.items()}
        place = dict(zip(("chunk_index", "file_index"), divmod(e, PER_CHUNK), strict=True))
        file = folder / DATA.format(**place)
        file.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table({name: _column(values) for name, values in frames.items()}), file)
        index.append(
            dict(episode_index=e, tasks=[task], length=length)
            | {f"data/{name}": value for name, value in place.items()}
            | dict(dataset_from_index=start, dataset_to_index=start + length)
            | {f"stats/{name}/{what}": value for name, values in frames.items() for what, value in _statistics(values).items()}
            | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        )
        start += length
    meta = folder / "meta"
    (meta / "episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(index), meta / "episodes/chunk-000/file-000.parquet")
    pq.write_table(_tasks(task), meta / "tasks.parquet")
    write_json(meta / "stats.json", {name: _joined(name, index) for name in features})
    info = dict(codebase_version="v3.0", robot_type="panda_gelsight", total_episodes=len(index), total_frames=start)
    info |= dict(total_tasks=1, chunks_size=PER_CHUNK, data_files_size_in_mb=100, video_files_size_in_mb=200, fps=FPS)
    info |= dict(splits=dict(train=f"0:{len(index)}"), data_path=DATA, video_path=None, features=features)
    write_json(folder / INFO, info)  # last: a folder without it is no dataset


def _pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{error}; LeRobot datasets need `pip install manifeel_ms3[lerobot]`") from error
    return pyarrow, pyarrow.parquet


def _is_picture(values: np.ndarray) -> bool:
    return values.dtype == np.uint8


def _described(values: np.ndarray) -> dict[str, Any]:
    """A feature's entry in info.json."""
    if _is_picture(values):
        return dict(dtype="image", shape=list(values.shape[1:]), names=["height", "width", "channels"])
    return dict(dtype=str(values.dtype), shape=list(values.shape[1:] or (1,)), names=None)


def _column(values: np.ndarray) -> Any:
    pa, _ = _pyarrow()
    if _is_picture(values):
        pictures = [dict(bytes=cv2.imencode(".png", picture[..., ::-1])[1].tobytes(), path=None) for picture in values]
        return pa.array(pictures, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
    kind = pa.from_numpy_dtype(values.dtype)
    if values.ndim == 2:
        kind = pa.list_(kind, values.shape[1])
    for _ in range(values.ndim - 1 if values.ndim > 2 else 0):
        kind = pa.list_(kind)
    return pa.array(values.tolist(), kind)


def _statistics(values: np.ndarray) -> dict[str, list]:
    """As lerobot has them: of pictures by channel in [0, 1], (3, 1, 1); of arrays by their last axis."""
    count = [len(values)]
    flat = values.reshape(-1, values.shape[-1] if values.ndim > 1 else 1).astype(float) / (255 if _is_picture(values) else 1)
    found = dict(min=flat.min(0), max=flat.max(0), mean=flat.mean(0), std=flat.std(0))
    found |= {name: np.quantile(flat, q, axis=0) for name, q in QUANTILES.items()}
    shape = (-1, 1, 1) if _is_picture(values) else (-1,)
    return {name: value.reshape(shape).tolist() for name, value in found.items()} | dict(count=count)


def _joined(name: str, index: list[dict[str, Any]]) -> dict[str, list]:
    """Statistics of all episodes from those of each; quantiles as their weighted means, as lerobot does."""
    of = {what: np.array([row[f"stats/{name}/{what}"] for row in index]) for what in ("min", "max", "mean", "std", *QUANTILES)}
    weight = np.array([row["length"] for row in index], float)
    weight /= weight.sum()

    def mean(values: np.ndarray) -> np.ndarray:
        return np.tensordot(weight, values, 1)

    found = dict(min=of["min"].min(0), max=of["max"].max(0), mean=mean(of["mean"]))
    found["std"] = np.sqrt(np.maximum(mean(of["std"] ** 2 + of["mean"] ** 2) - found["mean"] ** 2, 0))
    found |= {what: mean(of[what]) for what in QUANTILES}
    return {what: value.tolist() for what, value in found.items()} | dict(count=[sum(row["length"] for row in index)])


def _tasks(task: str) -> Any:
    """meta/tasks.parquet: a pandas table whose index is the task's name."""
    pa, _ = _pyarrow()
    column = dict(name="task_index", field_name="task_index", pandas_type="int64", numpy_type="int64", metadata=None)
    name = "__index_level_0__"
    index = dict(name=None, field_name=name, pandas_type="unicode", numpy_type="object", metadata=None)
    described = dict(index_columns=[name], column_indexes=[], columns=[column, index], pandas_version="2.0.0")
    return pa.table({"task_index": [0], name: [task]}).replace_schema_metadata({"pandas": json.dumps(described)})
