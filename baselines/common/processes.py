"""Training on several devices at once, with one process for each, started by `torchrun`."""

import os

import torch
import torch.distributed as dist
import torch.nn as nn


class Processes:
    """This process among those of a training run; the only one if `torchrun` did not start it.

    Args:
        device: Type of the device, "cuda" or "cpu".
    """

    def __init__(self, device: str):
        self.rank, self.count = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
        local = f":{os.environ['LOCAL_RANK']}" if "LOCAL_RANK" in os.environ and device == "cuda" else ""
        self.device = torch.device(device + local)
        if self.count > 1:
            dist.init_process_group("nccl" if self.device.type == "cuda" else "gloo")

    @property
    def first(self) -> bool:
        """Whether this process is the one that writes logs and checkpoints."""
        return self.rank == 0

    def with_mean_gradients(self, model: nn.Module) -> nn.Module:
        """The model, wrapped so that its gradients are the mean over all processes."""
        return nn.parallel.DistributedDataParallel(model) if self.count > 1 else model

    def of_first(self, value: str) -> str:
        """The text that the first process has."""
        values = [value]
        if self.count > 1:
            dist.broadcast_object_list(values, src=0, device=self.device)
        return values[0]

    def wait(self) -> None:
        """Wait until all processes have reached this call."""
        if self.count > 1:
            dist.barrier()

    def close(self) -> None:
        """Leave the group of processes."""
        if self.count > 1:
            dist.destroy_process_group()
