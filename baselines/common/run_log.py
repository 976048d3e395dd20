"""The log of a training run: log.jsonl, tensorboard events, and Weights & Biases."""

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter  # pyright: ignore[reportPrivateImportUsage] (torch does not list it)

from manifeel_ms3.errors import ServerError
from manifeel_ms3.files import write_text

LOG = "log.jsonl"
EVENTS = "events.out.tfevents.*"
"""Files of the log in the folder of a run: json lines, and tensorboard's events."""
WANDB_TIMEOUT = 30
"""Longest wait for Weights & Biases, s."""


class RunLog:
    """The log of a training run.

    The entries of a run that is resumed stay up to the checkpoint from which it goes on; the later ones are dropped, because
    they come again. Tensorboard's events are written anew from the entries that stay, since it can lose those of a process
    that was killed.

    Args:
        folder: Folder of the run.
        config: Settings of the run, for Weights & Biases.
        step: Step of the checkpoint from which the run goes on; 0 where it begins, and the log in the folder is replaced.
        wandb_project: Project of Weights & Biases; not used if None.

    Raises:
        ServerError: Weights & Biases cannot be reached.
        FileWriteError: The log cannot be written.
    """

    def __init__(self, folder: Path, config: dict[str, Any], step: int, wandb_project: str | None):
        self._wandb = _start_wandb(wandb_project, config, folder) if wandb_project else None
        self.entries = entries_until(folder / LOG, step)
        """The entries of the log that are kept from before."""
        write_text(folder / LOG, "".join(map(_line, self.entries)))
        for events in folder.glob(EVENTS):
            events.unlink()
        self._board = SummaryWriter(str(folder))
        for entry in self.entries:
            self._show(entry)
        self._lines = (folder / LOG).open("a", encoding="utf-8")

    def write(self, entry: Mapping[str, float]) -> None:
        """Write an entry: values by name, "step" among them."""
        self._lines.write(_line(entry))
        self._lines.flush()
        self._show(entry)
        if self._wandb:
            self._wandb.log(entry, step=int(entry["step"]))

    def sync(self) -> None:
        """Let all entries reach the disk; a checkpoint of their step may follow."""
        os.fsync(self._lines.fileno())

    def _show(self, entry: Mapping[str, float]) -> None:
        """Write an entry to tensorboard."""
        for name, value in entry.items():
            self._board.add_scalar(f"train/{name}", value, int(entry["step"]))

    def close(self) -> None:
        """Finish the log."""
        self._lines.close()
        self._board.close()
        if self._wandb:
            self._wandb.finish()


def entries_until(log: Path, step: int) -> list[dict[str, float]]:
    """The entries of a log up to a step; a line that a process was killed in is left out.

    Args:
        log: Path of the log, which need not exist.
        step: Last step whose entries are wanted.
    """
    entries = []
    for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if step and log.is_file() else []:
        try:
            entry = json.loads(line)
        except ValueError:
            continue
        if isinstance(entry, dict) and entry.get("step", math.inf) <= step:
            entries.append(entry)
    return entries


def _line(entry: Mapping[str, float]) -> str:
    return json.dumps(entry) + "\n"


def _start_wandb(project: str, config: dict[str, Any], folder: Path) -> Any:
    import wandb
    from wandb.errors import CommError, UsageError

    try:
        settings = wandb.Settings(init_timeout=WANDB_TIMEOUT)
        return wandb.init(project=project, config=config, dir=str(folder), settings=settings)
    except (CommError, UsageError) as error:
        raise ServerError(
            f"Weights & Biases does not accept the run ({error}); log in with `wandb login`, write it to disk with "
            "WANDB_MODE=offline, or leave out --wandb-project"
        ) from error
