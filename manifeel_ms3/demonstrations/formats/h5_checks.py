"""Checks of a trajectory file from anywhere: nothing is read from it before its whole structure has passed.

HDF5 lets a file name other files (external storage, virtual data sets, links) and declare sizes that it does not hold. A
trajectory file needs neither: the only links allowed are those of an index to the episodes beside it.
"""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
# (h5py annotates whatever a group can hold, and leaves its low-level modules out)
import math
from pathlib import Path
from typing import Any

import h5py

from .demonstration_format import MAX_COMPRESSION, POSE_SIZE, DemonstrationError

COMPRESSION = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_LZF}
"""HDF5's compressing filters that may be used, gzip and LZF; neither shrinks data more than `MAX_COMPRESSION` times."""
FILTERS = COMPRESSION | {h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
"""HDF5's filters that may be used; any other one would be loaded as a library."""
NUMBER_KINDS = "biuf"
"""numpy's kinds of numbers: Boolean, integers with and without a sign, and floating point."""
GROUPS = ("obs", "obs/sensor_data", "obs/extra", "env_states", "env_states/actors")
"""Parts of an episode that hold other parts; each one stands after its parent."""
PER_STEP = ("success", "fail", "terminated", "truncated", "contact_force", "rewards")
"""Parts of an episode with one number for each step."""


def check_trajectories(file: h5py.File, path: Path, episodes: Path) -> None:
    """Check a trajectory file, and the episodes that it links to where it is an index.

    Args:
        file: The opened file.
        path: Path of the file.
        episodes: Folder beside the file that holds the episodes of an index.

    Raises:
        DemonstrationError: The file names other files, declares arrays larger than it can hold, or has another form.
    """
    linked = [name for name in file if isinstance(file.get(name, getlink=True), h5py.ExternalLink)]
    _check_tree(file, path, skip=set(linked))
    for name in set(file) - set(linked):
        if name.startswith("traj_"):
            _check_episode(file[name], path)
    for target in sorted({_linked_episode(file.get(name, getlink=True), path, episodes) for name in linked}):
        with h5py.File(target, "r") as episode:
            _check_tree(episode, target)
            _check_episode(episode["traj_0"], target)


def _linked_episode(link: Any, path: Path, episodes: Path) -> Path:
    """The file of an index's link, which must be one of the episodes beside it."""
    name = Path(link.filename).name
    target = episodes / name
    if link.filename != f"{episodes.name}/{name}" or link.path.strip("/") != "traj_0" or target.is_symlink():
        raise _refused(path, f"it links to {link.filename}, and an index links only to files in {episodes.name}")
    if episodes.is_symlink() or not target.is_file():
        raise _refused(path, f"it is the index of {target}, which does not exist")
    return target


def _check_tree(file: h5py.File, path: Path, skip: set[str] = frozenset()) -> None:
    """Check every link and every array of a file."""
    todo: list[Any] = [file]
    seen, stored = {h5py.h5o.get_info(file["/"].id).addr}, 0
    while todo:
        group = todo.pop()
        for name in group if group.name != "/" else set(group) - skip:
            place = f"{group.name.rstrip('/')}/{name}"
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise _refused(path, f"{place} is a link to another place or file")
            item = group[name]
            address = h5py.h5o.get_info(item.id).addr
            if address in seen:
                raise _refused(path, f"{place} is the same object as another part")
            seen.add(address)
            if isinstance(item, h5py.Dataset):
                stored += _checked_size(item, path)
            else:
                todo.append(item)
    if stored > path.stat().st_size:
        raise _refused(path, f"its arrays claim {stored} stored bytes, more than the file has")


def _checked_size(item: h5py.Dataset, path: Path) -> int:
    """The number of bytes that an array takes in the file, which must hold all of its numbers."""
    properties = item.id.get_create_plist()
    if properties.get_external_count() or properties.get_layout() == h5py.h5d.VIRTUAL:
        raise _refused(path, f"the numbers of {item.name} are in another file")
    if item.shape is None or item.dtype.kind not in NUMBER_KINDS:
        raise _refused(path, f"{item.name} holds something other than numbers")
    filters = [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]
    if not FILTERS.issuperset(filters) or len(set(filters)) < len(filters):
        raise _refused(path, f"{item.name} is stored with the filters {filters}; gzip, LZF, shuffle and Fletcher32 can be read")
    stored = item.id.get_storage_size()
    size = math.prod(item.shape) * item.dtype.itemsize  # `Dataset.size` overflows
    chunk = math.prod(item.chunks or ()) * item.dtype.itemsize if size else 0
    if max(size, chunk) > stored * (MAX_COMPRESSION if COMPRESSION & set(filters) else 1):
        raise _refused(path, f"{item.name} declares {size} bytes {item.shape}, of which {stored} are stored")
    return stored


def _check_episode(episode: Any, path: Path) -> None:
    """Check that the parts of an episode that are read are groups, or arrays with the right number of axes."""
    if not isinstance(episode, h5py.Group):
        raise _refused(path, f"{episode.name} is not an episode")
    flat = isinstance(episode.get("obs"), h5py.Dataset) and episode["obs"].ndim == 2  # ManiSkill's vectors of states
    for name in GROUPS:
        if name in episode and not (flat and name == "obs"):
            _require(isinstance(episode[name], h5py.Group), path, episode, name)
    arrays = dict(actions=2) | dict.fromkeys(PER_STEP, 1)
    sensors: Any = episode.get("obs/sensor_data", {})
    for sensor in sensors:
        place = f"obs/sensor_data/{sensor}"
        _require(isinstance(episode[place], h5py.Group), path, episode, place)
        arrays |= {f"{place}/rgb": 4, f"{place}/force_field": 4}
    for name, axes in arrays.items():
        if name in episode:
            item = episode[name]
            right = isinstance(item, h5py.Dataset) and item.ndim == axes and len(item) > 0
            _require(right and (axes < 4 or item.shape[-1] == 3), path, episode, name)  # images and forces have 3 channels
    actors: Any = episode.get("env_states/actors", {})
    for name, item in actors.items():
        right = isinstance(item, h5py.Dataset) and item.ndim == 2 and len(item) > 0 and item.shape[1] >= POSE_SIZE
        _require(right, path, episode, f"env_states/actors/{name}")


def _require(right: bool, path: Path, episode: h5py.Group, name: str) -> None:
    if not right:
        raise _refused(path, f"{episode.name}/{name} is not what a trajectory file has there")


def _refused(path: Path, reason: str) -> DemonstrationError:
    return DemonstrationError(f"{path} is refused as a trajectory: {reason}; get it again from its source, or record it again")
