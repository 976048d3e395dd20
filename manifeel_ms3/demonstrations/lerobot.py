"""Read LeRobot datasets (format 3.0) as demonstrations.

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

from .trajectory_file import DemonstrationError

INFO = "meta/info.json"


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
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{error}; LeRobot datasets need `pip install manifeel_ms3[lerobot]`") from error
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
