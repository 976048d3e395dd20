"""The training loop that all policies share."""

import math
import random
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from diffusers.optimization import get_scheduler
from diffusers.training_utils import EMAModel

from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config
from manifeel_ms3.evaluation.provenance import machine
from manifeel_ms3.progress import progress_bar

from .agent import spec_of
from .background_evaluation import BackgroundEvaluation
from .checkpoint import (
    TRAINING,
    WEIGHTS,
    as_json,
    make_last,
    pack,
    prune,
    read_tensors,
    require_same_config,
    save_checkpoint,
    unpack,
)
from .dataset import SequenceDataset, read_episodes
from .encoders import load_representations
from .memory import keep_freed_memory, lay_out_channels_last
from .policy import PolicyConfig, VisuotactilePolicy
from .processes import Processes
from .run_log import RunLog

PAPER_EPOCHS = 50_000
ON_GPU = torch.cuda.is_available()


class TrainingError(RuntimeError):
    """Training cannot go on."""


@dataclass
class TrainArgs:
    """What all policies' scripts take; the defaults are the paper's."""

    demos: tuple[Path, ...]
    """trajectory files with observations, folders of LeRobot datasets, or zarr stores of the paper's layout"""
    env_id: str = "ManiFeel-PegInsertion-v1"
    """task; the files must be of it"""
    obs_mode: str = "rgb+tacff"
    """modalities: "rgb", "rgb+tacrgb", "rgb+tacff", "rgb+tacrgb+tacff", "tacff", ..."""
    cameras: tuple[str, ...] = ("wrist",)
    tactile_sensors: tuple[str, ...] = ("right",)
    image_size: int = 256
    tacrgb_weights: Path | None = None
    """weights of the tactile representation to begin with: as its authors released them, or from pretrain.py"""
    num_demos: int | None = None
    """episodes to train on; default: all"""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    inference_steps: int = 100
    """of generation, in evaluation"""
    batch_size: int = 8
    """samples a step, of each process"""
    steps: int | None = None
    """gradient steps; default: the paper's 50,000 epochs over all demonstrations, divided by their number"""
    lr: float = 1e-4
    betas: tuple[float, float] = (0.95, 0.999)
    weight_decay: float = 1e-6
    warmup_steps: int = 500
    ema_power: float = 0.75
    ema_max_decay: float = 0.9999
    seed: int = 0
    device: str = "cuda" if ON_GPU else "cpu"
    precision: Literal["fp32", "bf16"] = "bf16" if ON_GPU else "fp32"
    """of activations and gradients; weights are fp32"""
    compile: bool = ON_GPU
    """compile the networks; a minute or two, once"""
    run_dir: Path = Path("runs/policy")
    """log.jsonl, tensorboard events, checkpoints and evaluations go here"""
    save_every: int = 5000
    """gradient steps between checkpoints; the last is always written"""
    keep: int = 10
    """checkpoints kept"""
    eval_episodes: int = 0
    """evaluate every checkpoint on so many of the task's seeds, in processes of their own; 0: none"""
    eval_workers: int = 1
    eval_env_kwargs: str = "{}"
    """arguments of the task in evaluation, as json"""
    log_every: int = 50
    resume: bool = False
    """go on from the last checkpoint in run_dir"""
    wandb_project: str | None = None
    """log to Weights & Biases too; offline with WANDB_MODE=offline"""


FREE_ON_RESUME = {
    *("demos", "tacrgb_weights", "run_dir", "resume", "device", "compile", "log_every", "wandb_project"),
    *("steps", "step", "save_every", "keep", "inference_steps", "trained_on", "training_seconds"),
    *("eval_episodes", "eval_workers", "eval_env_kwargs"),
}


def default_steps(num_demos: int, num_samples: float, batch_size: int) -> int:
    """Number of gradient steps of the paper's public code: 50,000 epochs over all demonstrations, divided by their number."""
    return round(PAPER_EPOCHS / num_demos) * math.ceil(num_samples / batch_size)


def train(args: TrainArgs, policy_class: type[VisuotactilePolicy]) -> Path:
    """Train, and return the last checkpoint.

    Raises:
        DemonstrationError: the demonstrations are not what the arguments ask for.
        CheckpointError: the run that should go on was made with other settings, or is broken.
        TrainingError: the loss is not a number.
    """
    processes = Processes(args.device)
    device = processes.device
    keep_freed_memory(device)
    random.seed(args.seed)
    np.random.seed(args.seed)  # noqa: NPY002 (libraries draw from it)
    torch.manual_seed(args.seed)
    last = args.run_dir / "checkpoints/last"

    # data
    config = as_json(args)
    spec = spec_of(config)
    episodes = read_episodes(args.demos, args.env_id, spec, args.num_demos)
    dataset = SequenceDataset(episodes, spec, args.policy.obs_horizon, args.policy.pred_horizon, device)
    batch_size = args.batch_size * processes.count
    steps_per_epoch = math.ceil(len(dataset) / batch_size)
    total_steps = args.steps or default_steps(dataset.num_episodes, len(dataset), batch_size)
    action_dim = dataset.actions.shape[1]
    config |= dict(policy_name=policy_class.name, action_dim=action_dim)
    config |= dict(num_demos=dataset.num_episodes, num_samples=len(dataset))

    # policy, optimiser, schedule, EMA
    policy = policy_class(args.policy, spec, action_dim).to(device)
    lay_out_channels_last(policy)
    if args.tacrgb_weights and not args.resume:
        load_representations(policy, args.tacrgb_weights)
    policy.fit_normalizers(dataset.observations, dataset.actions)
    if args.compile:
        policy.encoder.compile()
        policy.unet.compile()
    optimizer = torch.optim.AdamW(policy.parameters(), args.lr, args.betas, weight_decay=args.weight_decay, fused=True)
    order_generator = torch.Generator().manual_seed(args.seed)
    start, order = 0, torch.empty(0, dtype=torch.long)  # samples left of this epoch
    begin = time.time()
    if args.resume:
        saved = checkpoint_config(last)
        require_same_config(saved, config, FREE_ON_RESUME, last)
        training = read_tensors(last / TRAINING)
        order = training.pop("order")
        order_generator.set_state(training.pop("order_random"))
        unpack(training, optimizer, policy, last)
        start = saved["step"]
        begin -= saved["training_seconds"]
    if not processes.first:
        torch.manual_seed(args.seed + 1_000_003 * processes.rank + start)  # noise of its own
    schedule = get_scheduler("cosine", optimizer, num_warmup_steps=args.warmup_steps, num_training_steps=total_steps)
    schedule.last_epoch = start
    for group in optimizer.param_groups:
        group["lr"] = args.lr * schedule.lr_lambdas[0](start)
    ema = EMAModel(
        policy.parameters(), args.ema_max_decay, use_ema_warmup=True, power=args.ema_power, inv_gamma=1.0, foreach=True
    )
    if args.resume:
        weights = read_tensors(last / WEIGHTS)
        ema.shadow_params = [weights[name].to(device) for name, _ in policy.named_parameters()]
        ema.optimization_step = start

    def save(step: int) -> Path:
        weights = dict(policy.state_dict())
        weights |= {name: s for (name, _), s in zip(policy.named_parameters(), ema.shadow_params, strict=True)}
        state = pack(optimizer, policy) | dict(order=order, order_random=order_generator.get_state())
        folder = args.run_dir / f"checkpoints/{step:08d}"
        cost = dict(trained_on=machine(), training_seconds=round(time.time() - begin, 1))
        save_checkpoint(folder, config | cost | dict(step=step), weights, state)
        make_last(folder)
        return folder

    # training
    log = RunLog(args.run_dir, config, args.resume, args.wandb_project) if processes.first else None
    evaluation = BackgroundEvaluation(args.run_dir / "evaluations", args.eval_episodes, args.eval_workers, args.eval_env_kwargs)
    model = processes.joined(policy).train()
    precision = torch.autocast(device.type, torch.bfloat16, enabled=args.precision == "bf16")
    losses, batches = torch.zeros(args.log_every, device=device), []
    with progress_bar(disable=not processes.first) as bar:
        task = bar.add_task("training", total=total_steps, completed=start)
        for step in range(start + 1, total_steps + 1):
            if len(order) < batch_size:
                order = torch.cat([order, torch.randperm(len(dataset), generator=order_generator)])
            batch, order = order[processes.rank : batch_size : processes.count], order[batch_size:]
            with precision:
                loss = model(*dataset.sample(batch.to(device)))
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            schedule.step()
            ema.step(policy.parameters())
            losses[len(batches)] = loss.detach()
            batches.append(batch)
            due = step % args.save_every == 0 or step == total_steps
            if len(batches) == args.log_every or due:  # the device is waited for only here
                _require_numbers(losses[: len(batches)], batches, step, dataset, args.run_dir)
                mean = float(losses[: len(batches)].mean())
                batches = []
                if log:
                    log.write(dict(step=step, loss=mean, lr=schedule.get_last_lr()[0], epoch=step / steps_per_epoch))
                bar.update(task, description=f"training, loss {mean:.4f}")
            if due and log:
                checkpoint = save(step)
                if args.eval_episodes:
                    evaluation.submit(checkpoint)
                prune(checkpoint.parent, args.keep, evaluation.in_use)
            if log and step % args.log_every == 0:
                for rate in evaluation.finished():
                    log.write(dict(step=step) | rate)
            bar.update(task, completed=step)
    if log:
        for rate in evaluation.finished(wait=True):
            log.write(dict(step=total_steps) | rate)
        prune(last.parent, args.keep, set())
        log.close()
    processes.wait()
    processes.close()
    return last


def _require_numbers(losses: torch.Tensor, batches: list[torch.Tensor], step: int, dataset: SequenceDataset, run: Path) -> None:
    wrong = (~torch.isfinite(losses)).nonzero()
    if len(wrong):
        first = int(wrong[0])
        where = f"step {step - len(batches) + 1 + first} is {float(losses[first])}, on {dataset.names(batches[first])}"
        raise TrainingError(
            f"the loss of {where}; look at these, lower --lr, or train with --precision fp32; what {run} holds is from before"
        )
