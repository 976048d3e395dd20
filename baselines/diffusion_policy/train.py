"""Train a Diffusion Policy on demonstrations.

    python baselines/diffusion_policy/train.py paper --demos trajectory.h5 --obs-mode rgb+tacff
    python baselines/diffusion_policy/train.py cpu --demos trajectory.h5 --obs-mode rgb+tacff

`paper` has the paper's hyperparameters, `cpu` a small network that learns on two cores in minutes.
"""

import json
import math
import random
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import tyro
from diffusers.optimization import get_scheduler
from diffusers.training_utils import EMAModel
from torch.utils.tensorboard import SummaryWriter

from baselines.common.checkpoint import as_json, pack, read_tensors, require_same_config, save_checkpoint, unpack
from baselines.common.dataset import SequenceDataset
from baselines.common.encoders import EncoderConfig
from baselines.diffusion_policy.agent import spec_of
from baselines.diffusion_policy.policy import DiffusionPolicy, PolicyConfig
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config
from manifeel_ms3.progress import progress_bar


@dataclass
class Args:
    demos: tuple[Path, ...]
    """trajectory files with observations"""
    env_id: str = "ManiFeel-PegInsertion-v1"
    """task; the files must be of it"""
    obs_mode: str = "rgb+tacff"
    """modalities: "rgb", "rgb+tacrgb", "rgb+tacff", "rgb+tacrgb+tacff", "tacff", ..."""
    cameras: tuple[str, ...] = ("wrist",)
    tactile_sensors: tuple[str, ...] = ("right",)
    image_size: int = 256
    num_demos: int | None = None
    """episodes to train on; default: all"""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    inference_steps: int = 100
    """denoising steps in evaluation: as many as diffusion steps is DDPM, fewer is DDIM"""
    batch_size: int = 8
    steps: int | None = None
    """gradient steps; default: the paper's 50,000 epochs over all demonstrations, divided by their number"""
    lr: float = 8e-5
    betas: tuple[float, float] = (0.95, 0.999)
    weight_decay: float = 1e-6
    warmup_steps: int = 500
    ema_power: float = 0.75
    ema_max_decay: float = 0.9999
    seed: int = 0
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    run_dir: Path = Path("runs/diffusion_policy")
    """log.jsonl, tensorboard events and checkpoints go here"""
    save_every: int = 5000
    """gradient steps between checkpoints; the last is always written"""
    log_every: int = 50
    resume: bool = False
    """go on from the last checkpoint in run_dir"""
    wandb_project: str | None = None
    """log to Weights & Biases too; offline with WANDB_MODE=offline"""


PRESETS = {
    "paper": ("the paper's hyperparameters", Args(demos=())),
    "cpu": (
        "a small network for two CPU cores",
        Args(
            demos=(),
            image_size=80,
            policy=PolicyConfig(
                action_horizon=4,
                obs_horizon=1,  # with two, its own motion tells a policy what to do next, and it stops looking
                encoder=EncoderConfig(image="small_cnn", force_field="small", crop=76),
                channels=(64, 128, 256),
                step_embedding=64,
                pose_noise=0.1,
                prediction="sample",
                noise_draws=2,
            ),
            inference_steps=8,
            batch_size=64,
            steps=2000,
            lr=1e-3,
            warmup_steps=100,
            save_every=1000,
        ),
    ),
}
FREE_ON_RESUME = {
    "steps",
    "device",
    "run_dir",
    "save_every",
    "log_every",
    "resume",
    "wandb_project",
    "inference_steps",
    "step",
    "demos",
}


def main(args: Args) -> Path:
    """Train, and return the last checkpoint's folder."""
    random.seed(args.seed)
    np.random.seed(args.seed)  # noqa: NPY002 (libraries draw from it)
    torch.manual_seed(args.seed)
    device = torch.device(args.device)
    last = args.run_dir / "checkpoints/last"

    # data
    config = as_json(args)
    spec = spec_of(config)
    horizons = (args.policy.obs_horizon, args.policy.pred_horizon)
    dataset = SequenceDataset(args.demos, args.env_id, spec, *horizons, args.num_demos, device)
    steps_per_epoch = math.ceil(len(dataset) / args.batch_size)
    total_steps = args.steps or steps_per_epoch * round(50_000 / dataset.num_episodes)
    config |= dict(kind="baselines.diffusion_policy.agent:DiffusionPolicyAgent", action_dim=dataset.actions.shape[1])
    config |= dict(num_demos=dataset.num_episodes, num_samples=len(dataset))

    # policy, optimiser, schedule, EMA
    policy = DiffusionPolicy(args.policy, spec, dataset.actions.shape[1]).to(device)
    policy.fit_normalizers(dataset.observations, dataset.actions)
    optimizer = torch.optim.AdamW(policy.parameters(), args.lr, args.betas, weight_decay=args.weight_decay)
    start, order = 0, torch.empty(0, dtype=torch.long, device=device)  # samples left of this epoch
    if args.resume:
        saved = checkpoint_config(last)
        require_same_config(saved, config, FREE_ON_RESUME, last)
        training = read_tensors(last / "training.safetensors")
        order = training.pop("order").to(device)
        unpack(training, optimizer, policy, last)
        start = saved["step"]
    schedule = get_scheduler("cosine", optimizer, num_warmup_steps=args.warmup_steps, num_training_steps=total_steps)
    for _ in range(start):
        schedule.step()
    ema = EMAModel(policy.parameters(), args.ema_max_decay, use_ema_warmup=True, power=args.ema_power, inv_gamma=1.0)
    if args.resume:
        weights = read_tensors(last / "model.safetensors")
        ema.shadow_params = [weights[name].to(device) for name, _ in policy.named_parameters()]
        ema.optimization_step = start

    # logs
    args.run_dir.mkdir(parents=True, exist_ok=True)
    board = SummaryWriter(str(args.run_dir))
    log = (args.run_dir / "log.jsonl").open("a" if args.resume else "w")
    if args.wandb_project:
        import wandb

        wandb.init(project=args.wandb_project, config=config, dir=str(args.run_dir), sync_tensorboard=False)

    def save(step: int) -> None:
        policy_weights = dict(policy.state_dict())
        policy_weights |= {name: s for (name, _), s in zip(policy.named_parameters(), ema.shadow_params, strict=True)}
        save_checkpoint(last, config | dict(step=step), policy_weights, pack(optimizer, policy) | dict(order=order))

    # training
    policy.train()
    running = 0.0
    with progress_bar() as bar:
        task = bar.add_task("training", total=total_steps, completed=start)
        for step in range(start + 1, total_steps + 1):
            if len(order) < args.batch_size:
                order = torch.cat([order, torch.randperm(len(dataset), device=device)])
            batch, order = order[: args.batch_size], order[args.batch_size :]
            loss = policy.loss(*dataset.sample(batch))
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            schedule.step()
            ema.step(policy.parameters())
            running += loss.detach()
            if step % args.log_every == 0 or step == total_steps:
                count = (step - 1) % args.log_every + 1
                entry = dict(step=step, loss=float(running) / count, lr=schedule.get_last_lr()[0], epoch=step / steps_per_epoch)
                running = 0.0
                log.write(json.dumps(entry) + "\n")
                log.flush()
                for name in ("loss", "lr"):
                    board.add_scalar(f"train/{name}", entry[name], step)
                if args.wandb_project:
                    wandb.log(entry, step=step)
                bar.update(task, description=f"training, loss {entry['loss']:.4f}")
            if step % args.save_every == 0 or step == total_steps:
                save(step)
            bar.update(task, completed=step)
    log.close()
    board.close()
    if args.wandb_project:
        wandb.finish()
    return last


if __name__ == "__main__":
    main(tyro.extras.overridable_config_cli(PRESETS))
