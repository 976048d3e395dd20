"""Training in two processes, which run what torchrun starts: the same function in each, told apart by its environment."""

import os
import socket
import weakref
from collections.abc import Callable
from dataclasses import replace

import torch
import torch.distributed as dist
from torch.multiprocessing.spawn import start_processes

from baselines.common.processes import Processes
from baselines.common.train_args import TrainArgs
from baselines.common.training import Trainer
from baselines.diffusion_policy.policy import DiffusionPolicy
from manifeel_ms3.workers import WorkerContext


def in_two_processes(what: Callable[[TrainArgs], None], args: TrainArgs) -> None:
    """Run a function in two processes, forked from the server that has imported most of what they need.

    What one of them raises is raised here.
    """
    WorkerContext()  # starts the server
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    start_processes(_run, (what, args, port), nprocs=2, daemon=True, start_method="forkserver")


def _run(rank: int, what: Callable[[TrainArgs], None], args: TrainArgs, port: int) -> None:
    os.environ |= dict(RANK=str(rank), LOCAL_RANK=str(rank), WORLD_SIZE="2", MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))
    torch.set_num_threads(1)
    what(args)


def resume_and_compare(args: TrainArgs) -> None:
    """Train, save and train on; then resume from what was saved, which must lead to the same weights in both processes."""
    processes = Processes("cpu")
    _resume_and_compare(args, processes)  # its trainers are gone when the group of processes ends
    processes.close()


def _resume_and_compare(args: TrainArgs, processes: Processes) -> None:
    whole = Trainer(args, DiffusionPolicy, processes)
    _take_steps(whole, 2)
    whole.save()
    _take_steps(whole, 2)
    resumed = Trainer(replace(args, resume=True), DiffusionPolicy, processes)
    assert resumed.step == 2
    _take_steps(resumed, 2)
    for (name, own), other in zip(resumed.policy.named_parameters(), whole.policy.parameters(), strict=True):
        assert torch.equal(own, other), name
    assert all(map(torch.equal, resumed.ema.shadow_params, whole.ema.shadow_params))
    _require_apart(resumed, processes)


def _require_apart(trainer: Trainer, processes: Processes) -> None:
    """Check that the processes take a step on other samples and with other noise each, and have the same weights after it."""
    seen, sample = [], trainer.dataset.sample
    trainer.dataset.sample = lambda index: seen.extend(index.tolist()) or sample(index)
    _take_steps(trainer, 1)
    first, second = processes.of_all(seen)
    assert len(first) == len(second) == trainer.args.batch_size
    assert not set(first) & set(second)
    noise = processes.of_all(torch.rand(1).item())
    assert noise[0] != noise[1]
    weights = processes.of_all([parameter.detach().sum().item() for parameter in trainer.policy.parameters()])
    assert weights[0] == weights[1]


def _take_steps(trainer: Trainer, count: int) -> None:
    for _ in range(count):
        trainer.take_step()


def end_before_the_evaluation(args: TrainArgs) -> None:
    """Train to the end, and look whether the last checkpoint has been evaluated when a process is done.

    The model with mean gradients must be gone before the group of processes ends, or a process may never end
    (`Processes.close`).
    """
    assert args.run_dir
    processes = Processes("cpu")
    trainer = Trainer(args, DiffusionPolicy, processes)
    model, end_group, ended = weakref.ref(trainer.model), dist.destroy_process_group, []

    def end_group_without_model() -> None:
        assert model() is None, "the model is the last owner of the group"
        end_group()
        ended.append(True)

    dist.destroy_process_group = end_group_without_model
    last = trainer.run()
    assert ended
    result = args.run_dir / f"evaluations/{last.resolve().name}.json"
    assert result.exists() == processes.first, "only the first process waits for the evaluation"
