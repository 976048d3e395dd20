"""The arrays of trajectory files, for comparisons of whole files."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from manifeel_ms3.demonstrations.formats.maniskill_h5 import open_trajectories


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a trajectory file by name, with those of the episodes that it links to."""
    found = {}
    with open_trajectories(path) as file:
        for i in range(len(file)):

            def keep(name: str, item, trajectory: str = f"traj_{i}") -> None:
                if isinstance(item, h5py.Dataset):
                    found[f"{trajectory}/{name}"] = item[()]

            file[f"traj_{i}"].visititems(keep)
    return found


def bytes_of(path: Path) -> dict[str, bytes]:
    """The same as bytes, which can be compared at once."""
    return {name: values.tobytes() for name, values in arrays_of(path).items()}


def renumbered(path: Path, folder: Path) -> Path:
    """A copy of a file of two episodes, the second of which has the number 0 and the first the number 4."""
    copy = Path(shutil.copy(path, folder / path.name))
    with h5py.File(copy, "r+") as file:
        file.move("traj_0", "traj_4")
        file.move("traj_1", "traj_0")
    header = json.loads(path.with_suffix(".json").read_text())
    for episode, number in zip(header["episodes"], (4, 0), strict=True):
        episode["episode_id"] = number
    copy.with_suffix(".json").write_text(json.dumps(header))
    return copy


def changed_copy(path: Path, folder: Path, key: str, change: Callable[[np.ndarray], np.ndarray], **env_kwargs: object) -> Path:
    """A copy of a file with an array of its last episode changed, which says that its task had these arguments, too."""
    copy = Path(shutil.copy(path, folder / f"changed_{path.name}"))
    with h5py.File(copy, "r+") as file:
        place = f"{list(file)[-1]}/{key}"
        values = change(file[place][()])
        del file[place]
        file[place] = values
    header = json.loads(path.with_suffix(".json").read_text())
    header["env_info"]["env_kwargs"] |= env_kwargs
    copy.with_suffix(".json").write_text(json.dumps(header))
    return copy
