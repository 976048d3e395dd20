"""The losses of the latest gradient steps, and the error that ends a training whose loss is not a finite number."""

from collections.abc import Callable

import torch

from manifeel_ms3.errors import WorkFailedError


class TrainingError(WorkFailedError):
    """Training cannot continue."""


class RecentLosses:
    """The losses since the last entry of the log, kept on the device so that steps need not wait for it.

    Args:
        size: Largest number of losses.
        device: Device that computes them.
    """

    def __init__(self, size: int, device: torch.device):
        self._losses, self._batches = torch.zeros(size, device=device), []

    @property
    def full(self) -> bool:
        """Whether there is no room for another loss."""
        return len(self._batches) == len(self._losses)

    def add(self, loss: torch.Tensor, batch: torch.Tensor) -> None:
        """Keep the loss of a batch of samples, given by their indices."""
        self._losses[len(self._batches)] = loss.detach()
        self._batches.append(batch)

    def take_mean(self, step: int, names: Callable[[torch.Tensor], str]) -> float:
        """The mean of the losses, which are then forgotten.

        Args:
            step: Gradient step of the last loss.
            names: Function from a batch to the names of its samples, for the error's message.

        Raises:
            TrainingError: A loss is not a finite number; the message names the step and the samples of the first such loss.
        """
        losses, batches = self._losses[: len(self._batches)], self._batches
        wrong = (~torch.isfinite(losses)).nonzero()
        if len(wrong):
            first = int(wrong[0])
            raise TrainingError(
                f"the loss of step {step - len(batches) + 1 + first} is {float(losses[first])}, on {names(batches[first])}; "
                "look at these demonstrations, lower --lr, or train with --precision fp32. Saved checkpoints are older"
            )
        self._batches = []
        return float(losses.mean())
