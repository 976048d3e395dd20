"""Export demonstrations: `manifeel export peg.h5 --to lerobot --out folder`."""

import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from manifeel_ms3.command_line import run
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.files import atomic_folder, write_json
from manifeel_ms3.ownership import owned
from manifeel_ms3.progress import progress_bar

from .formats import FORMATS
from .formats.demonstration_format import Progress
from .formats.lerobot_writing import write_lerobot
from .formats.maniskill_h5 import (
    DemonstrationError,
    about_task,
    observation_keys,
    observations_beside,
    read_header,
    read_trajectories,
)
from .recording import train_command

log = logging.getLogger(__name__)
Format = Literal["lerobot", "zarr", "npz"]


@dataclass
class Args:
    """Arguments of the command."""

    file: tyro.conf.Positional[Path]
    """Path of a trajectory file with observations."""
    to: Format
    """Format to write: "lerobot": LeRobot dataset (3.0); "zarr": layout of the paper's data; "npz": one file for each
    episode, with the arrays `actions` and, for example, `sensor_data.wrist.rgb`, and episodes.json, which names the task and
    the seeds; `manifeel train` does not read it."""
    out: Path
    """Folder to write; it must not exist yet."""
    videos: bool = False
    """Store the cameras' images of a LeRobot dataset as videos, which are smaller but not lossless; touch stays lossless."""


def write_npz(path: Path, folder: Path, progress: Progress = iter) -> None:
    """Write one npz file for each episode, with `actions` (T, A) and the observations (T + 1, ...).

    Observations have their keys as names, with "." for "/". The file episodes.json names the task, its arguments, and the seed
    of each file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    header, names = read_header(path), []
    for i, episode in enumerate(read_trajectories(path, observation_keys(path), progress=progress)):
        arrays: dict[str, Any] = {key.replace("/", "."): values for key, values in episode.items()}
        names.append(f"episode_{i:05d}.npz")
        np.savez_compressed(folder / names[-1], **arrays)
    seeds = [episode["episode_seed"] for episode in header["episodes"]]
    episodes = [dict(file=name, episode_seed=seed) for name, seed in zip(names, seeds, strict=True)]
    write_json(folder / "episodes.json", about_task(header) | dict(episodes=episodes))


WRITERS: dict[str, Callable[[Path, Path, Progress], None]] = {
    "npz": write_npz,  # not one of the formats, because this package does not read it
    **{known.name: known.write for known in FORMATS if known.write is not None},
}


def main(args: Args) -> Path:
    """Export a trajectory file, and return the folder, which appears whole or not at all.

    Raises:
        DemonstrationError: The file cannot be exported, or the folder exists already.
        InvalidArgumentError: Videos are requested in a format that has none.
        MissingExtraError: The library that writes the format is not installed.
    """
    if args.videos and args.to != "lerobot":
        raise InvalidArgumentError(f"--videos is for --to lerobot, not for --to {args.to}; leave it out")
    write = partial(write_lerobot, videos=True) if args.videos else WRITERS[args.to]
    with owned(args.out):
        if args.out.exists():
            raise DemonstrationError(f"{args.out} exists already; give another --out, or delete it")
        if left_out := observations_beside(args.file, observation_keys(args.file)):
            log.info("a data set holds images, force fields and the pose of the tool; left out: %s", ", ".join(left_out))
        with atomic_folder(args.out) as folder, progress_bar() as bar:
            folder.rmdir()  # writers make their folder themselves
            write(args.file, folder, lambda indices: bar.track(indices, description=f"exporting {args.file.name}"))
    return args.out


def next_step(args: Args, made: Path) -> str:
    """What the command made, and what one can do with it."""
    if args.to == "npz":
        return f"{made} holds one file for each episode, which `numpy.load` opens, and their seeds in episodes.json"
    train = train_command(made, read_header(args.file))
    return f"{made} is a data set of the format {args.to}" + (f"; {train} trains on it" if train else "")


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
