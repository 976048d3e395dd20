"""Train a tactile representation on TacRGB images alone, from demonstrations or any other trajectory file that holds them.

    python -m baselines.tactile_representations.pretrain unit --demo-path nut.h5 --env-id ManiFeel-NutBoltAssembly-v1
    python -m baselines.tactile_representations.pretrain t3 --demo-path a.h5 b.h5 --out t3.safetensors

The first command does what the paper ManiFeel does for all its tasks. UniT is trained as a VQGAN (Esser et al. 2021), the
transformers by masked autoencoding; the option `--tacrgb-weights` of a policy's training takes the result.
"""

import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F  # noqa: N812
import tyro
from tyro.conf import arg

from baselines.common.checkpoint import write_tensors
from baselines.common.memory import keep_freed_memory
from baselines.common.observation import is_tactile, prepare_images
from baselines.common.recent_losses import TrainingError
from manifeel_ms3.arguments import require_amount, require_file, require_positive
from manifeel_ms3.command_line import as_typed, run
from manifeel_ms3.demonstrations import DemonstrationError
from manifeel_ms3.demonstrations.formats.folder_checks import require_task
from manifeel_ms3.demonstrations.formats.maniskill_h5 import about_task, group_of, open_trajectories, read_header
from manifeel_ms3.errors import FileExistsAlreadyError
from manifeel_ms3.evaluation.policy import checked_device
from manifeel_ms3.files import atomic_write
from manifeel_ms3.ownership import owned
from manifeel_ms3.progress import progress_bar

from .anytouch import AnyTouch
from .encoder import require_size
from .masked_autoencoder import MaskedAutoencoder
from .representation import TokenRepresentation, in_unit_range
from .sparsh import Sparsh
from .t3 import T3
from .unit import UniT

MAE_BETAS, MAE_WEIGHT_DECAY = (0.9, 0.95), 0.05
"""Decay rates of AdamW's moments, and its weight decay (He et al. 2022, table 8)."""
VQGAN_BETAS = (0.5, 0.9)
"""Decay rates of Adam's moments, as in the public code of Esser et al. (2021)."""
EPOCHS = 50
"""Number of times that training sees each image on average, unless told otherwise; that of the paper's public code for UniT."""
ADVERSARY_WEIGHT = 0.1
"""Weight of the discriminator's judgement in the loss; constant, whereas Esser et al. (2021, eq. 7) adapt theirs."""
REPRESENTATIONS: dict[str, type[UniT] | type[TokenRepresentation]] = dict(unit=UniT, t3=T3, anytouch=AnyTouch, sparsh=Sparsh)
"""Networks of the representations, by name."""
Representation = Literal["unit", "t3", "anytouch", "sparsh"]
"""Names of the representations that can be trained."""


@dataclass
class Args:
    """Settings of the training of a tactile representation."""

    representation: tyro.conf.Positional[Representation]
    """Name of the representation."""
    demos: Annotated[tuple[Path, ...], arg(name="demo-path", aliases=["--demos"])]
    """Trajectory files with TacRGB images."""
    env_id: str | None = None
    """Environment id of the task that all demonstrations must be of; any tasks if not given."""
    out: Path | None = None
    """File of the trained weights, which appears when training has ended; <representation>.safetensors if not given."""
    overwrite: bool = False
    """Replace the file of earlier weights if there is one."""
    image_size: int | None = None
    """Height and width to which images are resized, pixels, the same as TacRGB has in the policy's training; if not given, 256
    for unit and 224 for the others, as in the paper."""
    batch_size: int = 16
    """Number of images in a gradient step; the default is that of the paper's public code for UniT."""
    steps: Annotated[int | None, arg(name="total-iters", aliases=["--steps"])] = None
    """Number of gradient steps; if not given, those of 50 epochs, as in the paper's public code for UniT."""
    lr: float = 7.2e-5
    """Learning rate of the optimiser; the default is that of the paper's public code for UniT, 4.5e-6 for each of 16 images."""
    adversary_from: int = 2000
    """Gradient step from which a discriminator judges the images that UniT reconstructs; the default is that of the paper's
    public code."""
    seed: int = 0
    """Seed of the initial weights and of the order of the images."""
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    """Device that trains, "cuda" or "cpu"."""
    log_freq: Annotated[int, arg(aliases=["--log-every"])] = 10
    """Number of gradient steps between two losses that are shown and returned."""


def main(args: Args) -> list[float]:
    """Train, write the weights, and return every `log_freq`-th loss.

    Raises:
        InvalidArgumentError: A number is too small, the representation does not take images of this size, or the path of the
            weights is a folder.
        DemonstrationError: The files hold no TacRGB images, or are of another task than asked for or of another revision of it.
        FileExistsAlreadyError: The file of the weights exists, and is not to be overwritten.
        FileWriteError: The weights cannot be written.
        TrainingError: The loss is not a finite number.
        InUseError: Another process trains into the same file.
    """
    require_positive(image_size=args.image_size, batch_size=args.batch_size, total_iters=args.steps, log_freq=args.log_freq)
    require_amount("--lr ", args.lr)
    out = out_file(args)
    require_file("--out", out, f"{args.representation}.safetensors")
    with owned(out):
        if out.exists() and not args.overwrite:
            raise FileExistsAlreadyError(f"{out} holds weights already; give another --out, or --overwrite to replace them")
        return _pretrain(args, out)


def out_file(args: Args) -> Path:
    """Path of the file of the trained weights."""
    return args.out or Path(f"{args.representation}.safetensors")


def _pretrain(args: Args, out: Path) -> list[float]:
    torch.manual_seed(args.seed)
    representation = REPRESENTATIONS[args.representation]().to(checked_device(args.device))
    size = args.image_size or representation.size
    require_size(representation, size, "--image-size")
    images = torch.as_tensor(tacrgb_images(args.demos, size, args.env_id))
    representation.fit([images])
    keep_freed_memory(args.device)
    if isinstance(representation, UniT):
        training = VqganTraining(representation, args)
    else:
        training = MaeTraining(representation, args, size)
    losses, steps = [], math.ceil(EPOCHS * len(images) / args.batch_size) if args.steps is None else args.steps
    with progress_bar() as bar:
        task = bar.add_task("training", total=steps)
        for step in range(steps):
            batch = images[torch.randint(len(images), (args.batch_size,))].to(args.device)
            loss = training.step(batch.movedim(-1, 1).float() / 127.5 - 1, step)
            if step % args.log_freq == 0:
                losses.append(float(loss))
                if not math.isfinite(losses[-1]):
                    raise TrainingError(
                        f"the loss of step {step} is {losses[-1]}; lower --lr, or train with more images in a --batch-size. No "
                        "weights are written"
                    )
                bar.update(task, description=f"training, loss {losses[-1]:.4f}")
            bar.advance(task)
    with atomic_write(out) as partial:
        write_tensors(partial, representation.state_dict())
    return losses


def tacrgb_images(files: Iterable[Path], size: int, env_id: str | None = None) -> np.ndarray:
    """All TacRGB images of trajectory files, uint8 (N, size, size, 3).

    Args:
        files: Trajectory files.
        size: Height and width to which images are resized, pixels.
        env_id: Environment id of the task that all files must be of; any tasks if None.

    Raises:
        DemonstrationError: The files hold no TacRGB images, or are of another task than asked for or of another revision of it.
    """
    images = []
    for path in files:
        header = read_header(path)
        require_task(path, about_task(header), env_id)
        with open_trajectories(path) as file:
            for episode in header["episodes"]:
                sensors = group_of(file, episode).get("obs/sensor_data", {})
                pads = [
                    sensors[name]["rgb"] for name in sensors if is_tactile(f"sensor_data/{name}") and "rgb" in sensors[name]
                ]
                images += [prepare_images(pad[()], size) for pad in pads]
    if not images:
        raise DemonstrationError(f"{[str(f) for f in files]} hold no TacRGB images; record them with --obs-mode tacrgb")
    return np.concatenate(images)


class MaeTraining:
    """Training of a transformer by masked autoencoding.

    Args:
        representation: The transformer.
        args: Settings of the training.
        size: Side of the images, pixels.
    """

    def __init__(self, representation: TokenRepresentation, args: Args, size: int):
        self.model = MaskedAutoencoder(representation, size).to(args.device)
        self.optimizer = torch.optim.AdamW(self.model.parameters(), args.lr, MAE_BETAS, weight_decay=MAE_WEIGHT_DECAY)

    def step(self, image: torch.Tensor, step: int) -> torch.Tensor:
        """Take gradient step number `step` on images (B, 3, H, W) in [-1, 1], and return the loss."""
        loss = self.model(image)
        _descend(self.optimizer, loss)
        return loss.detach()


class VqganTraining:
    """Training of UniT's VQGAN by its absolute error, its codebook loss and, later, a discriminator of patches.

    The perceptual loss of the original is left out, because it needs a network that was trained on photographs.

    Args:
        unit: The representation.
        args: Settings of the training.
    """

    def __init__(self, unit: UniT, args: Args):
        self.vqgan, self.adversary_from = unit.vqgan, args.adversary_from
        self.discriminator = patch_discriminator().to(args.device)
        self.optimizer = torch.optim.Adam(self.vqgan.parameters(), args.lr, VQGAN_BETAS)
        self.adversary = torch.optim.Adam(self.discriminator.parameters(), args.lr, VQGAN_BETAS)

    def step(self, image: torch.Tensor, step: int) -> torch.Tensor:
        """Take gradient step number `step` on images (B, 3, H, W) in [-1, 1], and return the loss."""
        image = in_unit_range(image)
        decoded = self.vqgan(image)
        error = F.l1_loss(decoded.sample, image)
        loss = error + decoded.commit_loss.mean()
        if step >= self.adversary_from:
            loss = loss + ADVERSARY_WEIGHT * -self.discriminator(decoded.sample).mean()
        _descend(self.optimizer, loss)
        if step >= self.adversary_from:
            real, fake = self.discriminator(image), self.discriminator(decoded.sample.detach())
            _descend(self.adversary, 0.5 * (F.relu(1 - real).mean() + F.relu(1 + fake).mean()))
        return error.detach()


DISCRIMINATOR_WIDTH, DISCRIMINATOR_KERNEL, DISCRIMINATOR_SLOPE = 64, 4, 0.2
"""Channels of the discriminator's first layer, kernel of its convolutions, and slope of its activations for negative inputs
(Isola et al. 2017, section 6.1)."""


def patch_discriminator() -> nn.Sequential:
    """A network that judges patches of 70 x 70 pixels, each as real or reconstructed (Isola et al. 2017)."""
    width, kernel, slope = DISCRIMINATOR_WIDTH, DISCRIMINATOR_KERNEL, DISCRIMINATOR_SLOPE
    layers: list[nn.Module] = [nn.Conv2d(3, width, kernel, 2, 1), nn.LeakyReLU(slope)]
    for inputs, outputs, stride in ((width, 2 * width, 2), (2 * width, 4 * width, 2), (4 * width, 8 * width, 1)):
        layers += [nn.Conv2d(inputs, outputs, kernel, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.LeakyReLU(slope)]
    return nn.Sequential(*layers, nn.Conv2d(8 * width, 1, kernel, 1, 1))


def _descend(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    optimizer.step()


def next_step(args: Args, _losses: list[float]) -> str:
    """What the command made, and what one can do with it."""
    out, size = out_file(args), args.image_size or REPRESENTATIONS[args.representation].size
    flags = ("--policy.encoder.tacrgb", args.representation, "--tacrgb-weights", out, "--tactile-image-size", size)
    return f"{out} holds the weights; {as_typed('manifeel', 'train', '...', *flags)} trains a policy with them"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
