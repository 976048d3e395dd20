"""Speed of the training loop compared with a plain one: `python benchmarks/train_speed.py`.

The plain loop is what one would write first: a DataLoader that makes one sample at a time, fp32, eager, library convolutions.
Both train the same Diffusion Policy with the paper's sizes on the same images, with two image encoders (camera and TacRGB).
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import cycle, islice
from types import MethodType
from typing import Literal

import numpy as np
import torch
import torch.nn as nn
import tyro
from diffusers.training_utils import EMAModel
from rich.console import Console
from rich.table import Table
from torch.utils.data import DataLoader, Dataset

from baselines.common.dataset import Demonstration, SequenceDataset
from baselines.common.encoders import TACRGB_ENCODERS, EncoderConfig
from baselines.common.memory import keep_freed_memory, lay_out_channels_last
from baselines.common.observation import POSE, observation_spec
from baselines.common.train_args import ON_GPU, TrainArgs
from baselines.common.unet import SequenceConv
from baselines.diffusion_policy.policy import DiffusionConfig, DiffusionPolicy
from baselines.diffusion_policy.train import LR
from baselines.tactile_representations.pretrain import REPRESENTATIONS

RNG = np.random.default_rng(0)
WARM_UP = 2
"""Number of gradient steps before the timed ones."""


@dataclass
class Args:
    device: str = "cuda" if ON_GPU else "cpu"
    """Device that trains, "cuda" or "cpu"."""
    batch_size: int = 64 if ON_GPU else 8
    """Number of samples in a gradient step."""
    image_size: int = 256
    """Height and width of the images, pixels; those of TacRGB are 224 for tactile representations."""
    steps: int = 30 if ON_GPU else 6
    """Number of timed gradient steps of each loop."""
    precision: Literal["fp32", "bf16"] = "bf16" if ON_GPU else "fp32"
    """Number format of activations and gradients in our loop."""
    compile: bool = ON_GPU
    """Compile the networks in our loop."""
    tacrgb: tuple[str, ...] = ("resnet18",)
    """Names of the TacRGB encoders that are timed; the paper's four are resnet18, unit, t3 and anytouch."""
    demos: int = 103
    """Number of demonstrations in an epoch, that of the paper's runtime comparison."""
    demo_steps: int = 84
    """Number of steps of a demonstration, that of the paper's runtime comparison."""


SPEC_SENSORS = ("rgb+tacrgb", ("wrist",), ("right",))
"""Observation mode, cameras and pads of the policy."""


def random_episodes(spec, count: int, length: int) -> list[Demonstration]:
    def episode() -> Demonstration:
        sizes = {key: (length + 1, spec.size_of(key), spec.size_of(key), 3) for key in spec.images}
        images = {key: RNG.integers(0, 255, size, np.uint8) for key, size in sizes.items()}
        return images | {
            POSE: RNG.random((length + 1, spec.pose_features), np.float32),
            "actions": RNG.random((length, 6), np.float32),
        }

    return [episode() for _ in range(count)]


class PlainDataset(Dataset):
    """Makes samples one by one, with images as floats."""

    def __init__(self, data: SequenceDataset):
        self.data = data

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, index: int):
        obs, actions = self.data.sample(torch.tensor([index]))
        return {key: value[0].float() if value.dtype == torch.uint8 else value[0] for key, value in obs.items()}, actions[0]


def plain_loop(args: Args, policy: DiffusionPolicy, data: SequenceDataset) -> Iterator[None]:
    for module in policy.modules():
        if isinstance(module, SequenceConv):
            module.forward = MethodType(nn.Conv1d.forward, module)
    optimizer = torch.optim.AdamW(policy.parameters(), LR, foreach=False)
    ema = EMAModel(policy.parameters(), power=TrainArgs.ema_power)
    for obs, actions in cycle(DataLoader(PlainDataset(data), args.batch_size, shuffle=True)):
        loss = policy({key: value.to(args.device) for key, value in obs.items()}, actions.to(args.device))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        ema.step(policy.parameters())
        loss.item()
        yield


def our_loop(args: Args, policy: DiffusionPolicy, data: SequenceDataset) -> Iterator[None]:
    """The gradient steps of `baselines.common.training`, without its log and checkpoints."""
    keep_freed_memory(args.device)
    lay_out_channels_last(policy)
    if args.compile:
        policy.encoder.compile()
        policy.action_network.compile()
    optimizer = torch.optim.AdamW(policy.parameters(), LR, fused=True)
    ema = EMAModel(policy.parameters(), power=TrainArgs.ema_power, foreach=True)
    precision = torch.autocast(args.device, torch.bfloat16, enabled=args.precision == "bf16")
    while True:
        batch = torch.randperm(len(data))[: args.batch_size].to(args.device)
        with precision:
            loss = policy(*data.sample(batch))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        ema.step(policy.parameters())
        yield


def seconds_a_step(args: Args, loop: Callable, tacrgb: str, plain_data: bool) -> float:
    torch.manual_seed(0)
    size = getattr(REPRESENTATIONS.get(tacrgb), "size", args.image_size)
    spec = observation_spec(*SPEC_SENSORS, args.image_size, size)
    data = SequenceDataset(random_episodes(spec, 4, 60), spec, 2, 16, 8, torch.device("cpu" if plain_data else args.device))
    policy = DiffusionPolicy(DiffusionConfig(encoder=EncoderConfig(tacrgb=tacrgb)), spec, 6).to(args.device)
    steps = loop(args, policy, data)
    for _ in islice(steps, WARM_UP):
        pass
    synchronise = torch.cuda.synchronize if args.device == "cuda" else lambda: None
    synchronise()
    start = time.perf_counter()
    for _ in islice(steps, args.steps):
        pass
    synchronise()
    seconds = (time.perf_counter() - start) / args.steps
    Console().print(f"{loop.__name__}, {tacrgb}: {1000 * seconds:.1f} ms a gradient step")
    return seconds


def main(args: Args) -> None:
    if unknown := set(args.tacrgb) - set(TACRGB_ENCODERS):
        raise SystemExit(f"tacrgb encoders {sorted(unknown)} are unknown; choose from {sorted(TACRGB_ENCODERS)}")
    title = (
        f"batch {args.batch_size}, {args.image_size} pixels, {args.device}, {torch.get_num_threads()} threads, {args.precision}"
    )
    table = Table("TacRGB encoder", "plain, img/s", "ours, img/s", "ratio", "ours, min/epoch", title=title)
    images = 2 * 2 * args.batch_size  # two sensors, two steps of observation
    batches = args.demos * args.demo_steps / args.batch_size
    plain_seconds = [seconds_a_step(args, plain_loop, tacrgb, plain_data=True) for tacrgb in args.tacrgb]
    our_seconds = [seconds_a_step(args, our_loop, tacrgb, plain_data=False) for tacrgb in args.tacrgb]
    for tacrgb, plain, ours in zip(args.tacrgb, plain_seconds, our_seconds, strict=True):
        row = (f"{images / plain:.1f}", f"{images / ours:.1f}", f"{plain / ours:.2f}", f"{batches * ours / 60:.1f}")
        table.add_row(tacrgb, *row)
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Args))
