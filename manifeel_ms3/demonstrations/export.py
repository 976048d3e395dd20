"""Demonstrations for other tools: `python -m manifeel_ms3.demonstrations.export trajectory.h5 --to lerobot --out folder`."""

import logging
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from manifeel_ms3.command_line import run
from manifeel_ms3.progress import progress_bar

from .formats.diffusion_policy_zarr import write_zarr
from .formats.lerobot import write_lerobot
from .formats.maniskill_h5 import DemonstrationError, each_demonstration, observed

log = logging.getLogger(__name__)
Format = Literal["lerobot", "zarr", "npz"]


@dataclass
class Args:
    file: tyro.conf.Positional[Path]
    """trajectory file with observations"""
    to: Format
    """"lerobot": a LeRobot dataset (3.0); "zarr": the layout of the paper's data; "npz": a file an episode"""
    out: Path
    """folder; must not be there yet"""


def write_npz(path: Path, folder: Path, progress: Callable = iter) -> None:
    """A file an episode: `actions` (T, A) and every observation (T + 1, ...) by its path, "/" as "."."""
    for i, episode in enumerate(each_demonstration(path, observed(path), progress)):
        folder.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(
            folder / f"episode_{i:05d}.npz", **{key.replace("/", "."): values for key, values in episode.items()}
        )


WRITERS: dict[str, Callable[..., None]] = dict(lerobot=write_lerobot, zarr=write_zarr, npz=write_npz)


def main(args: Args) -> Path:
    """Export, and return the folder: whole, or not there.

    Raises:
        DemonstrationError: the file cannot be exported, or the folder is there already.
        ModuleNotFoundError: the format's extra is not installed.
    """
    if args.out.exists():
        raise DemonstrationError(f"{args.out} is there already; give another --out, or delete it")
    partial = args.out.with_name(args.out.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    with progress_bar() as bar:
        WRITERS[args.to](args.file, partial, lambda indices: bar.track(indices, description=f"exporting {args.file.name}"))
    partial.replace(args.out)
    log.info("%s", args.out)
    return args.out


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
