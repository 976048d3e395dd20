"""Training on several devices at once, with one process for each, started by `torchrun`."""

import os
from collections.abc import Callable
from typing import Any

import torch
import torch.distributed as dist
import torch.nn as nn

from manifeel_ms3.errors import ManifeelError
from manifeel_ms3.evaluation.policy import checked_device


class Processes:
    """This process among those of a training run; the only one if `torchrun` did not start it.

    Args:
        device: "cpu", "cuda", or one GPU by its number, such as "cuda:1". With `torchrun`, "cuda" gives each process a GPU of
            its own; a GPU that has a number would be shared by all of them.

    Raises:
        InvalidArgumentError: The name is not that of a device.
        MachineError: This machine does not have the device.
    """

    def __init__(self, device: str):
        self.rank, self.count = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
        own = "LOCAL_RANK" in os.environ and device == "cuda"
        self.device = torch.device(checked_device(f"cuda:{os.environ['LOCAL_RANK']}" if own else device))
        gpu = self.device if own else None
        if self.device.type == "cuda" and self.device.index is not None:
            torch.cuda.set_device(self.device)  # or what names no GPU, such as the noise, would be on the first one
        if self.count > 1:
            dist.init_process_group("nccl" if self.device.type == "cuda" else "gloo", device_id=gpu)

    @property
    def first(self) -> bool:
        """Whether this process is the one that writes logs and checkpoints."""
        return self.rank == 0

    def with_mean_gradients(self, model: nn.Module) -> nn.Module:
        """The model, wrapped so that its gradients are the mean over all processes."""
        return nn.parallel.DistributedDataParallel(model) if self.count > 1 else model

    def first_does(self, work: Callable[[], Any]) -> None:
        """Let the first process do something while the others wait; an error that it raises is raised in all of them."""
        raised = None
        if self.first:
            try:
                work()
            except ManifeelError as error:
                raised = error
        if (raised := self.of_first(raised)) is not None:
            raise raised

    def of_first(self, value: Any) -> Any:
        """What the first process has."""
        values = [value]
        if self.count > 1:
            dist.broadcast_object_list(values, src=0, device=self.device)
        return values[0]

    def of_all(self, value: Any) -> list[Any]:
        """What each process gives, in the order of their ranks; all processes call it together."""
        values = [value] * self.count
        if self.count > 1:
            dist.all_gather_object(values, value)
        return values

    def close(self) -> None:
        """Wait until all processes have reached this call, and leave the group.

        What `with_mean_gradients` has returned must be gone before: if it were the group's last owner, this process could wait
        for ever, because it would end the group's threads with Python's lock held, which a thread may need to end
        (seen with gloo and torch 2.13, once in about 100 runs on two busy cores).
        """
        if self.count > 1:
            dist.barrier()
            dist.destroy_process_group()
