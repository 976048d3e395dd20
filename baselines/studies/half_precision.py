"""Write a copy of a checkpoint in half precision, as evaluations of studies with `half_precision: true` use it.

    python -m baselines.studies.half_precision runs/x/checkpoints/00007000 --out published/00007000

The copy holds what is published: rounded weights and the settings, without the state of training and without local paths.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from baselines.common.checkpoint import save_in_half_precision
from manifeel_ms3.command_line import as_typed, run


@dataclass
class Args:
    """Arguments of the command."""

    checkpoint: tyro.conf.Positional[Path]
    """Folder of the checkpoint."""
    out: Path
    """Folder of the copy; a copy that is there already stays as it is."""


def main(args: Args) -> Path:
    """Write the copy where it is missing, and return its folder.

    Raises:
        CheckpointError: The checkpoint is missing or broken.
        FileWriteError: The copy cannot be written.
    """
    if not args.out.is_dir():
        save_in_half_precision(args.checkpoint, args.out)
    return args.out


def next_step(_args: Args, made: Path) -> str:
    """What the command made, and what one can do with it."""
    return f"{made} has the rounded weights; {as_typed('manifeel', 'eval', '--checkpoint', made)} evaluates them"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
