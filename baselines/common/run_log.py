"""The log of a training run: log.jsonl, tensorboard events, and Weights & Biases."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter  # pyright: ignore[reportPrivateImportUsage] (torch does not list it)

from manifeel_ms3.errors import ServerError

WANDB_TIMEOUT = 30
"""Longest wait for Weights & Biases, s."""


class RunLog:
    """The log of a training run.

    Args:
        folder: Folder of the run.
        config: Settings of the run, for Weights & Biases.
        resume: Whether to append to the log in the folder; else it is replaced.
        wandb_project: Project of Weights & Biases; not used if None.

    Raises:
        ServerError: Weights & Biases cannot be reached.
    """

    def __init__(self, folder: Path, config: dict[str, Any], resume: bool, wandb_project: str | None):
        self._wandb = _start_wandb(wandb_project, config, folder) if wandb_project else None
        folder.mkdir(parents=True, exist_ok=True)
        self._board = SummaryWriter(str(folder))
        self._lines = (folder / "log.jsonl").open("a" if resume else "w")

    def write(self, entry: Mapping[str, float]) -> None:
        """Write an entry: values by name, "step" among them."""
        self._lines.write(json.dumps(entry) + "\n")
        self._lines.flush()
        for name, value in entry.items():
            self._board.add_scalar(f"train/{name}", value, int(entry["step"]))
        if self._wandb:
            self._wandb.log(entry, step=int(entry["step"]))

    def close(self) -> None:
        """Finish the log."""
        self._lines.close()
        self._board.close()
        if self._wandb:
            self._wandb.finish()


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
