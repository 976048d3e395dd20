"""Where training writes how it goes: log.jsonl, tensorboard events, Weights & Biases."""

import json
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter

WANDB_TIMEOUT = 30  # s


class RunLog:
    """A run's log; `resume` adds to what is there.

    Raises:
        ConnectionError: Weights & Biases cannot be reached.
    """

    def __init__(self, folder: Path, config: dict[str, Any], resume: bool, wandb_project: str | None):
        self._wandb = _start_wandb(wandb_project, config, folder) if wandb_project else None
        folder.mkdir(parents=True, exist_ok=True)
        self._board = SummaryWriter(str(folder))
        self._lines = (folder / "log.jsonl").open("a" if resume else "w")

    def write(self, entry: dict[str, float]) -> None:
        """An entry with its "step"."""
        self._lines.write(json.dumps(entry) + "\n")
        self._lines.flush()
        for name, value in entry.items():
            self._board.add_scalar(f"train/{name}", value, int(entry["step"]))
        if self._wandb:
            self._wandb.log(entry, step=int(entry["step"]))

    def close(self) -> None:
        self._lines.close()
        self._board.close()
        if self._wandb:
            self._wandb.finish()


def _start_wandb(project: str, config: dict[str, Any], folder: Path) -> Any:
    import wandb

    try:
        settings = wandb.Settings(init_timeout=WANDB_TIMEOUT)
        return wandb.init(project=project, config=config, dir=str(folder), settings=settings)
    except (wandb.errors.CommError, wandb.errors.UsageError) as error:
        raise ConnectionError(
            f"Weights & Biases does not take the run ({error}); log in with `wandb login`, write it to disk with "
            "WANDB_MODE=offline, or leave out --wandb-project"
        ) from error
