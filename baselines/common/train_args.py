"""The settings of a training run."""

import math
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Literal

import torch

from manifeel_ms3.tasks.registry import short_name

from .observation import PoseForm
from .policy import PolicyConfig

PUBLIC_CODE_LR = 1e-4
"""Learning rate in the paper's public code, but for its Diffusion Policy; the paper's table has 8e-5 for all policies."""
PAPER_EPOCHS = 50_000
"""Training epochs of the paper, summed over all demonstrations: with n demonstrations a policy trains 50,000 / n epochs."""
ON_GPU = torch.cuda.is_available()
"""Whether a GPU is available, which the defaults then use."""


@dataclass
class TrainArgs:
    """Settings of a training run. The defaults are those of the paper's public code."""

    demos: tuple[Path, ...]
    """Trajectory files with observations, folders of LeRobot datasets, or zarr stores of the paper's layout."""
    env_id: str = "ManiFeel-PegInsertion-v1"
    """Environment id of the task that the demonstrations are of."""
    obs_mode: str = "rgb+tacff"
    """Modalities that the policy observes: "rgb", "rgb+tacrgb", "rgb+tacff", "rgb+tacrgb+tacff", "tacff", ..."""
    cameras: tuple[str, ...] = ("wrist",)
    """Names of the cameras that the policy observes: "front", "side" or "wrist"."""
    tactile_sensors: tuple[str, ...] = ("right",)
    """Sides of the tactile sensors that the policy observes: "left" or "right"."""
    image_size: int = 256
    """Height and width to which camera images are resized, pixels."""
    tactile_image_size: int = 256
    """Height and width to which TacRGB images are resized, pixels; 224 for T3 and AnyTouch in the paper."""
    pose: PoseForm = "quaternion"
    """Form of the tool's pose: "quaternion" is the paper's, 7 numbers, with a sign that does not jump while the hand points
    down; "rotation_6d" has 9 numbers, the position and two columns of the rotation matrix."""
    tacrgb_weights: Path | None = None
    """File of weights with which the tactile representation starts: as its authors released them, or from pretrain.py."""
    num_demos: int | None = None
    """Number of training episodes; all of them if not given."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """Settings of the policy."""
    inference_steps: int = 100
    """Number of generation steps in evaluation."""
    batch_size: int = 8
    """Number of samples in a gradient step of each process."""
    steps: int | None = None
    """Number of gradient steps; if not given, the paper's 50,000 epochs divided by the number of demonstrations."""
    lr: float | None = None
    """Learning rate of AdamW after the warm-up, from which it falls to 0 along a cosine; if not given, that of the paper's
    public code."""
    betas: tuple[float, float] = (0.95, 0.999)
    """Decay rates of AdamW's first and second moments."""
    weight_decay: float = 1e-6
    """Weight decay of AdamW."""
    warmup_steps: int = 500
    """Number of gradient steps over which the learning rate rises from 0."""
    ema_power: float = 0.75
    """Exponent of the EMA's warm-up: after n steps the decay is 1 - (1 + n) ** -ema_power."""
    ema_max_decay: float = 0.9999
    """Upper limit of the EMA's decay."""
    seed: int = 0
    """Seed of the initial weights, the order of the samples and the noise."""
    device: str = "cuda" if ON_GPU else "cpu"
    """Device that trains, "cuda" or "cpu"."""
    precision: Literal["fp32", "bf16"] = "bf16" if ON_GPU else "fp32"
    """Number format of activations and gradients; weights are always fp32."""
    compile: bool = ON_GPU
    """Compile the networks before training, which takes a minute or two."""
    run_dir: Path | None = None
    """Folder of log.jsonl, tensorboard events, checkpoints and evaluations; a new one if not given,
    runs/<policy>/<task>-<obs_mode>-seed<seed>-<date>-<time>."""
    save_every: int = 5000
    """Number of gradient steps between checkpoints; the last step always has one."""
    keep: int = 10
    """Number of checkpoints that are kept."""
    eval_episodes: int = 0
    """Number of the task's seeds on which each checkpoint is evaluated, in other processes; no evaluation if 0."""
    eval_workers: int = 1
    """Number of processes of an evaluation."""
    eval_env_kwargs: str = "{}"
    """Arguments of the task in evaluation, as a json object."""
    log_every: int = 50
    """Number of gradient steps between entries of the log."""
    resume: bool = False
    """Continue from the last checkpoint in run_dir."""
    overwrite: bool = False
    """Delete the checkpoints, the log and the evaluations of an earlier run in run_dir, and begin anew."""
    wandb_project: str | None = None
    """Project of Weights & Biases that receives the log, too; WANDB_MODE=offline writes it to disk."""

    def public_code_lr(self) -> float:
        """The learning rate of the paper's public code for these settings."""
        return PUBLIC_CODE_LR


FREE_ON_RESUME = {
    *("demos", "tacrgb_weights", "run_dir", "resume", "overwrite", "device", "compile", "log_every", "wandb_project"),
    *("steps", "total_steps", "step", "save_every", "keep", "inference_steps", "trained_on", "training_seconds"),
    *("eval_episodes", "eval_workers", "eval_env_kwargs"),
}
"""Settings that may change when a run is resumed."""


def default_run_dir(args: TrainArgs, policy: str) -> Path:
    """Folder of a new run, named by what it trains and by the present time.

    Args:
        args: Settings of the run.
        policy: Registered name of the policy.
    """
    now = datetime.now().strftime("%Y%m%d-%H%M%S")
    return Path("runs") / policy / f"{short_name(args.env_id)}-{args.obs_mode}-seed{args.seed}-{now}"


def default_steps(num_demos: int, num_samples: float, batch_size: int) -> int:
    """Number of gradient steps of the paper's public code: 50,000 epochs divided by the number of demonstrations.

    Args:
        num_demos: Number of training episodes.
        num_samples: Number of samples in an epoch (`SequenceDataset`).
        batch_size: Number of samples in a gradient step.
    """
    return round(PAPER_EPOCHS / num_demos) * math.ceil(num_samples / batch_size)
