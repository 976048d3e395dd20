"""Check demonstrations: `manifeel validate data/demos --replay 2`.

A folder is checked against its manifest; one trajectory file is checked by itself.
"""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tyro

from manifeel_ms3.arguments import require_not_negative
from manifeel_ms3.command_line import run
from manifeel_ms3.errors import ManifeelError
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.tasks.registry import FIRST_EVALUATION_SEED

from .dataset import describe, read_manifest
from .formats.maniskill_h5 import group_of, open_trajectories, read_header
from .replay import replay

log = logging.getLogger(__name__)
CHECKED = ("sha256", "json_sha256")
"""Keys that a manifest's entry must have, without which nothing tells whether the file is the one that it describes."""


@dataclass
class Args:
    """Arguments of the command."""

    path: tyro.conf.Positional[Path]
    """Folder that holds a manifest.json, or one trajectory file."""
    replay: int = 0
    """Number of episodes of each file to replay from their actions; all of a file that has fewer."""


def validate(path: Path, num_replays: int = 0) -> list[str]:
    """Faults of a set of demonstrations, or of one file of them, one line each; an empty list if there are none.

    Args:
        path: Folder that holds the manifest, or a trajectory file.
        num_replays: Number of episodes of each file to replay from their actions; all of a file that has fewer.

    Raises:
        DemonstrationError: The folder has no manifest that can be read.
    """
    path = Path(path)
    if path.is_file() or (path.suffix == ".h5" and not path.is_dir()):  # a file that is missing is named as a file
        return _problems_of_file(path, None, num_replays)
    problems = []
    files = read_manifest(path)["files"]
    with progress_bar() as bar:
        for name, entry in bar.track(files.items(), description="checking"):
            problems += [f"{name}: {problem}" for problem in _problems(path, name, entry, num_replays)]
    return problems


def _problems(folder: Path, name: str, entry: dict[str, Any], num_replays: int) -> list[str]:
    """Faults of one trajectory file, given its name and its entry in the manifest."""
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        return [f"a manifest only names files in its own folder {folder}; get it again from its source"]
    return _problems_of_file(path, entry, num_replays)


def _problems_of_file(path: Path, entry: dict[str, Any] | None, num_replays: int) -> list[str]:
    """Faults of one trajectory file, given what a manifest says of it; None if there is no manifest."""
    try:
        episodes = read_header(path)["episodes"]
        problems = [] if entry is None else _manifest_problems(describe(path), entry)
        with open_trajectories(path) as file:
            named = {f"traj_{episode['episode_id']}" for episode in episodes}
            if more := sorted(name for name in file if name.startswith("traj_") and name not in named):
                problems.append(f"it holds {more}, which its json file does not name; the two may be of different recordings")
            for episode in episodes:
                problems += [f"seed {episode['episode_seed']}: {problem}" for problem in _episode_problems(file, episode)]
    except (ManifeelError, OSError) as error:
        return [str(error)]
    seeds = [episode["episode_seed"] for episode in episodes]
    if shared := [seed for seed in seeds if seed >= FIRST_EVALUATION_SEED]:
        problems.append(f"seeds {sorted(shared)} are evaluation seeds; demonstrations use seeds below {FIRST_EVALUATION_SEED}")
    if len(set(seeds)) < len(seeds):
        problems.append("a seed occurs twice")
    if num := min(num_replays, len(episodes)):
        problems += _replay_problems(path, num)
    return problems


def _replay_problems(path: Path, num: int) -> list[str]:
    """Which of the first `num` episodes of a file do not come out as they were recorded, or why they cannot be replayed."""
    try:
        replays = replay(path, num)
    except (ManifeelError, OSError) as error:
        return [str(error)]
    moved = [replayed for replayed in replays if replayed.deviation > 0]
    return [
        f"seed {other.seed} does not come out as recorded (off by {other.deviation:.1e}); this is a fault if the file was "
        "recorded on this processor and with these versions, and may be rounding otherwise"
        for other in moved
    ]


def _manifest_problems(found: dict[str, Any], entry: dict[str, Any]) -> list[str]:
    """Where a manifest's entry says something else of a file than what was found in it."""
    unknown = [f"the manifest has the unknown key {key!r}; a key is one of {list(found)}" for key in entry.keys() - found]
    differing = [key for key in found if key in entry and found[key] != entry[key]]
    lacking = [f"the manifest does not say its {key}; get the manifest again" for key in CHECKED if key not in entry]
    return unknown + lacking + [f"{key} is {found[key]!r}, the manifest says {entry[key]!r}" for key in differing]


def _episode_problems(file: Any, episode: dict[str, Any]) -> list[str]:
    """Faults of one episode, given its entry in the json."""
    group, steps = group_of(file, episode), episode["elapsed_steps"]
    problems = []
    if not group["success"][-1]:
        problems.append("it does not end in success")
    elif not episode.get("success", True):
        problems.append("it ends in success, and its json file says that it does not")
    if "delta" in str(episode.get("control_mode", "delta")) and np.abs(group["actions"][()]).max() > 1:
        problems.append("an action is beyond its limits")

    def check(name: str, item: h5py.HLObject) -> None:
        if not isinstance(item, h5py.Dataset):
            return
        expected = steps + 1 if name.startswith(("obs", "env_states")) else steps
        if len(item) != expected:
            problems.append(f"{name} has {len(item)} entries instead of {expected}")
        elif item.dtype.kind == "f" and not np.isfinite(item[()]).all():
            problems.append(f"{name} holds NaN or infinite numbers")

    group.visititems(check)
    return problems


def main(args: Args) -> int:
    """Log the faults, and return 1 if there are any, else 0.

    Raises:
        InvalidArgumentError: The number of replays is negative.
        DemonstrationError: The folder has no manifest that can be read.
    """
    require_not_negative(replay=args.replay)
    problems = validate(args.path, args.replay)
    for problem in problems:
        log.error(problem)
    log.info("%d problems", len(problems))
    return int(bool(problems))


def next_step(args: Args, wrong: int) -> str:
    """What the command found, and what one can do next."""
    if wrong:
        return f"mend {args.path}: get it again from its source, or record it again with `manifeel record`"
    return f"{args.path} is in order; `manifeel summary FILE` describes a file, `manifeel train` trains a policy on it"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
