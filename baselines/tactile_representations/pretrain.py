"""Train a tactile representation on TacRGB pictures alone, from demonstrations or any trajectory file that holds some.

    python -m baselines.tactile_representations.pretrain unit --demos a.h5 b.h5 --out unit.safetensors
    python -m baselines.tactile_representations.pretrain t3 --demos a.h5 --out t3.safetensors

UniT as a VQGAN (Esser et al. 2021), the transformers by masked autoencoding; `train.py --tacrgb-weights` takes the result.
"""

import logging
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from safetensors.torch import save_file

from baselines.common.memory import keep_freed_memory
from baselines.common.observation import is_tactile, prepare_images
from manifeel_ms3.command_line import run
from manifeel_ms3.demonstrations import DemonstrationError
from manifeel_ms3.demonstrations.formats.maniskill_h5 import open_trajectories, read_header
from manifeel_ms3.progress import progress_bar

from .anytouch import AnyTouch
from .masked_autoencoder import MaskedAutoencoder
from .representation import Representation
from .sparsh import Sparsh
from .t3 import T3
from .unit import UniT

log = logging.getLogger(__name__)
REPRESENTATIONS: dict[str, Callable[[], Representation]] = dict(unit=UniT, t3=T3, anytouch=AnyTouch, sparsh=Sparsh)


@dataclass
class Args:
    representation: tyro.conf.Positional[Literal["unit", "t3", "anytouch", "sparsh"]]
    demos: tuple[Path, ...]
    """trajectory files with TacRGB"""
    out: Path = Path("representation.safetensors")
    image_size: int = 224
    """pixels a side, as the policy will see them"""
    batch_size: int = 32
    steps: int = 20_000
    lr: float = 1e-4
    adversary_from: int = 5000
    """step from which UniT's pictures are judged by a discriminator"""
    seed: int = 0
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    every: int = 10
    """steps between losses kept"""


def main(args: Args) -> list[float]:
    """Train, write the weights, and return the losses, one of `every` steps.

    Raises:
        DemonstrationError: the files hold no TacRGB.
    """
    torch.manual_seed(args.seed)
    pictures = torch.as_tensor(tacrgb_pictures(args.demos, args.image_size))
    keep_freed_memory(args.device)
    representation = REPRESENTATIONS[args.representation]().to(args.device)
    objective = VqganObjective(representation, args) if isinstance(representation, UniT) else MaeObjective(representation, args)
    losses = []
    with progress_bar() as bar:
        task = bar.add_task("training", total=args.steps)
        for step in range(args.steps):
            batch = pictures[torch.randint(len(pictures), (args.batch_size,))].to(args.device)
            loss = objective.step(batch.movedim(-1, 1).float() / 127.5 - 1, step)
            if step % args.every == 0:
                losses.append(float(loss))
                bar.update(task, description=f"training, loss {losses[-1]:.4f}")
            bar.advance(task)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    save_file({name: t.contiguous() for name, t in objective.result.state_dict().items()}, args.out)
    log.info("%s", args.out)
    return losses


def tacrgb_pictures(files: Iterable[Path], size: int) -> np.ndarray:
    """All TacRGB pictures of trajectory files, uint8 (N, size, size, 3).

    Raises:
        DemonstrationError: there are none.
    """
    pictures = []
    for path in files:
        with open_trajectories(path) as file:
            for i in range(len(read_header(path)["episodes"])):
                sensors: Any = file[f"traj_{i}"].get("obs/sensor_data", {})
                pads = [
                    sensors[name]["rgb"] for name in sensors if is_tactile(f"sensor_data/{name}") and "rgb" in sensors[name]
                ]
                pictures += [prepare_images(pad[()], size) for pad in pads]
    if not pictures:
        raise DemonstrationError(f"{[str(f) for f in files]} hold no TacRGB; record them with --obs-mode tacrgb")
    return np.concatenate(pictures)


class MaeObjective:
    def __init__(self, representation: Representation, args: Args):
        self.result = representation
        self.model = MaskedAutoencoder(representation, args.image_size).to(args.device)
        self.optimizer = torch.optim.AdamW(self.model.parameters(), args.lr, (0.9, 0.95), weight_decay=0.05)

    def step(self, image: torch.Tensor, step: int) -> torch.Tensor:
        loss = self.model(image)
        _descend(self.optimizer, loss)
        return loss.detach()


class VqganObjective:
    """Pictures through the quantised code and back: absolute error, codebook, and, later, a discriminator of patches.

    The perceptual loss of the original is left out: it needs a network trained on photographs.
    """

    def __init__(self, unit: UniT, args: Args):
        self.result, self.vqgan, self.adversary_from = unit.saved, unit.vqgan, args.adversary_from
        self.discriminator = patch_discriminator().to(args.device)
        adam = dict(lr=args.lr, betas=(0.5, 0.9))
        self.optimizer = torch.optim.Adam(self.vqgan.parameters(), **adam)
        self.adversary = torch.optim.Adam(self.discriminator.parameters(), **adam)

    def step(self, image: torch.Tensor, step: int) -> torch.Tensor:
        told = self.vqgan(image)
        error = F.l1_loss(told.sample, image)
        loss = error + told.commit_loss.mean()
        if step >= self.adversary_from:
            loss = loss + ADVERSARY_WEIGHT * -self.discriminator(told.sample).mean()
        _descend(self.optimizer, loss)
        if step >= self.adversary_from:
            real, fake = self.discriminator(image), self.discriminator(told.sample.detach())
            _descend(self.adversary, 0.5 * (F.relu(1 - real).mean() + F.relu(1 + fake).mean()))
        return error.detach()


ADVERSARY_WEIGHT = 0.1


def patch_discriminator(width: int = 64) -> nn.Sequential:
    """Judges patches of 70 pixels (Isola et al. 2017)."""
    layers: list[nn.Module] = [nn.Conv2d(3, width, 4, 2, 1), nn.LeakyReLU(0.2)]
    for inputs, outputs, stride in ((width, 2 * width, 2), (2 * width, 4 * width, 2), (4 * width, 8 * width, 1)):
        layers += [nn.Conv2d(inputs, outputs, 4, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.LeakyReLU(0.2)]
    return nn.Sequential(*layers, nn.Conv2d(8 * width, 1, 4, 1, 1))


def _descend(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    optimizer.step()


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
