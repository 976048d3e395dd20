"""The settings of a training run."""

import math
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal

import torch
from tyro.conf import arg

from manifeel_ms3.arguments import flag_of, require_amount, require_choices, require_not_negative, require_positive
from manifeel_ms3.command_line import json_object, missing_extras_named
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.tasks.checks import check_argument_names, check_obs_mode, check_seed
from manifeel_ms3.tasks.registry import short_name, task_spec

from .observation import CameraView, PoseForm
from .policy import PolicyConfig

PUBLIC_CODE_LR = 1e-4
"""Learning rate in the paper's public code, except for Diffusion Policy; the paper's table has 8e-5 for all policies."""
PAPER_EPOCHS = 50_000
"""Number of training epochs in the paper times the number of demonstrations: with n demonstrations, 50,000 / n epochs."""
ON_GPU = torch.cuda.is_available()
"""Whether a GPU is available, which the defaults then use."""


@dataclass
class TrainArgs:
    """Settings of a training run. The defaults are those of the paper's public code."""

    demos: Annotated[tuple[Path, ...], arg(name="demo-path", aliases=["--demos"])]
    """Trajectory files with observations, folders of LeRobot datasets, or zarr stores of the paper's layout."""
    env_id: str | None = None
    """Environment id of the task; that which the demonstrations name if not given."""
    obs_mode: str = "rgb+tacff"
    """Modalities that the policy observes: "rgb", "rgb+tacrgb", "rgb+tacff", "rgb+tacrgb+tacff", "tacff", ..."""
    cameras: tuple[str, ...] | None = None
    """Names of the cameras that the policy observes: "front", "side" or "wrist"; the task's policy camera if not given."""
    tactile_sensors: tuple[str, ...] = ("right",)
    """Sides of the tactile sensors that the policy observes: "left" or "right"."""
    image_size: int = 256
    """Height and width to which camera images are resized, pixels."""
    camera_view: CameraView = "whole"
    """Part of the camera images that the policy observes: "whole" images as in the paper, or "work", the square of each
    camera's image in which the work is done, so that the same number of pixels shows it finer."""
    tactile_image_size: int = 256
    """Height and width to which TacRGB images are resized, pixels; 224 for T3 and AnyTouch in the paper."""
    pose: PoseForm = "quaternion"
    """Form of the tool's pose: "quaternion" is the paper's, 7 numbers, with a sign that does not jump while the hand points
    down; "rotation_6d" has 9 numbers, the position and two columns of the rotation matrix."""
    tacrgb_weights: Path | None = None
    """File of the weights with which the tactile representation starts: from its authors, or from
    `python -m baselines.tactile_representations.pretrain`."""
    num_demos: int | None = None
    """Number of training episodes; all of them if not given."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """Settings of the policy."""
    inference_steps: int = 100
    """Number of generation steps in evaluation."""
    batch_size: int = 8
    """Number of samples in a gradient step of each process."""
    steps: Annotated[int | None, arg(name="total-iters", aliases=["--steps"])] = None
    """Number of gradient steps; if not given, `epochs` says how long training is."""
    epochs: int | None = None
    """Number of epochs where neither --total-iters nor the preset gives a number of gradient steps, as "cpu" does; if neither
    is given, 50,000 divided by the number of demonstrations, as in the paper."""
    min_steps: Annotated[int, arg(name="min-iters")] = 1
    """Smallest number of gradient steps of a training whose length is given in epochs."""
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
    exp_name: str | None = None
    """Name of the run: of its folder, runs/<exp_name>, and of the run in Weights & Biases. If not given, it is
    <policy>/<task>-<obs_mode>-seed<seed>-<date>-<time>."""
    run_dir: Path | None = None
    """Folder of log.jsonl, tensorboard events, checkpoints and evaluations; runs/<exp_name> if not given."""
    save_freq: Annotated[int, arg(aliases=["--save-every"])] = 5000
    """Number of gradient steps between checkpoints; steps that are evaluated, and the last one, have one, too."""
    keep: int = 10
    """Number of checkpoints that are kept."""
    eval_freq: int | None = None
    """Number of gradient steps between evaluations, each of a checkpoint of that step; every checkpoint is evaluated if not
    given. The last one always is."""
    num_eval_episodes: Annotated[int, arg(aliases=["--eval-episodes"])] = 0
    """Number of the task's seeds on which a checkpoint is evaluated, in other processes; no evaluation if 0."""
    num_eval_envs: Annotated[int, arg(aliases=["--eval-workers"])] = 1
    """Number of environments of an evaluation, each in a process of its own."""
    eval_env_kwargs: str = "{}"
    """Arguments of the task in evaluation, as a json object."""
    capture_video: bool = False
    """Record the first episode of each evaluation as a video, in <run_dir>/evaluations/videos."""
    log_freq: Annotated[int, arg(aliases=["--log-every"])] = 50
    """Number of gradient steps between entries of the log."""
    resume: bool = False
    """Continue from the last checkpoint in run_dir."""
    overwrite: bool = False
    """Delete the checkpoints, the log and the evaluations of an earlier run in run_dir, and start a new run."""
    track: bool = False
    """Send the log to Weights & Biases, too; WANDB_MODE=offline writes it to disk."""
    wandb_project_name: Annotated[str, arg(aliases=["--wandb-project"])] = "ManiFeel"
    """Project of Weights & Biases."""
    wandb_entity: str | None = None
    """Team or user of Weights & Biases; the user's default if not given."""

    def public_code_lr(self) -> float:
        """The learning rate of the paper's public code for these settings."""
        return PUBLIC_CODE_LR

    def with_task_defaults(self) -> "TrainArgs":
        """These settings with the full id of their task, and with its policy camera if they name no cameras.

        Raises:
            UnknownNameError: The task is not registered.
            DemonstrationError: Neither the settings nor the demonstrations name the task.
        """
        from .dataset import recorded_task  # imported here, because it loads h5py, which changes what a fork does

        task = task_spec(self.env_id or recorded_task(self.demos))
        return replace(self, env_id=task.env_id, cameras=(task.policy_camera,) if self.cameras is None else self.cameras)


FREE_ON_RESUME = {
    *("demos", "tacrgb_weights", "exp_name", "run_dir", "resume", "overwrite", "device", "compile", "log_freq"),
    *("steps", "epochs", "min_steps", "total_steps", "step", "save_freq", "keep", "inference_steps"),
    *("trained_on", "training_seconds"),
    *("eval_freq", "num_eval_episodes", "num_eval_envs", "eval_env_kwargs", "capture_video"),
    *("track", "wandb_project_name", "wandb_entity"),
}
"""Settings that may change when a run is resumed."""


def check_run(args: TrainArgs) -> None:
    """Check that the numbers of a run can be met, and that its settings do not contradict each other.

    Raises:
        InvalidArgumentError: A number is out of its range, the run to resume is not named, or is to be overwritten, evaluations
            fall between checkpoints, or no demonstrations are given.
    """
    require_positive(
        num_demos=args.num_demos,
        image_size=args.image_size,
        tactile_image_size=args.tactile_image_size,
        batch_size=args.batch_size,
        total_iters=args.steps,
        epochs=args.epochs,
        min_iters=args.min_steps,
        save_freq=args.save_freq,
        keep=args.keep,
        eval_freq=args.eval_freq,
        num_eval_episodes=args.num_eval_episodes or None,  # 0 asks for no evaluation
        num_eval_envs=args.num_eval_envs,
        inference_steps=args.inference_steps,
        log_freq=args.log_freq,
    )
    require_not_negative(seed=args.seed, warmup_steps=args.warmup_steps)
    check_seed(args.seed)
    for flag, amount in (("--lr ", args.lr or 0.0), ("--weight-decay ", args.weight_decay), ("--ema-power ", args.ema_power)):
        require_amount(flag, amount)
    for flag, rate in (*(("--betas", beta) for beta in args.betas), ("--ema-max-decay", args.ema_max_decay)):
        if not 0 <= rate < 1:  # also where it is NaN
            raise InvalidArgumentError(f"{flag} {rate}: a decay rate must be at least 0 and below 1")
    require_choices(args)
    if not args.policy.can_generate_in(args.inference_steps):
        raise InvalidArgumentError(
            f"--inference-steps {args.inference_steps}: this policy needs {args.policy.step_range} to generate"
        )
    if args.resume and ((args.run_dir is None and args.exp_name is None) or args.overwrite):
        raise InvalidArgumentError(
            "--resume needs --run-dir or --exp-name, the folder or the name of the run to continue, and excludes --overwrite"
        )
    if not args.demos:
        raise InvalidArgumentError("no demonstrations are given; give --demo-path FILE, which `manifeel record` makes")


def check_evaluation(args: TrainArgs) -> None:
    """Check the arguments of the task in evaluation, since an evaluation that fails does not stop the training.

    Args:
        args: Settings of the run, with its task.

    Raises:
        InvalidArgumentError: They are not a json object, the task does not take one of them, or they ask for other observations
            than those of the policy; or nothing is evaluated.
        MissingExtraError: The extra that videos need is not installed.
    """
    assert args.env_id is not None
    given = json_object("--eval-env-kwargs", args.eval_env_kwargs)
    check_argument_names(task_spec(args.env_id).env_class, given.keys() - {"max_episode_steps"})  # which gym.make takes
    check_obs_mode("--eval-env-kwargs", given, args.obs_mode)
    for_evaluations = dict(eval_freq=args.eval_freq, eval_env_kwargs=given, capture_video=args.capture_video)
    if not args.num_eval_episodes and (unused := [flag_of(name) for name, value in for_evaluations.items() if value]):
        raise InvalidArgumentError(
            f"{', '.join(unused)} without --num-eval-episodes: no checkpoint is evaluated; give a number of episodes, too"
        )
    if args.num_eval_episodes and args.capture_video:
        with missing_extras_named():
            import manifeel_ms3.evaluation.video  # noqa: F401


def default_exp_name(args: TrainArgs, policy: str) -> str:
    """Name of a new run, after what it trains and the present time.

    Args:
        args: Settings of the run, with its task.
        policy: Registered name of the policy.
    """
    assert args.env_id is not None
    now = datetime.now().strftime("%Y%m%d-%H%M%S")
    return f"{policy}/{short_name(args.env_id)}-{args.obs_mode}-seed{args.seed}-{now}"


def planned_steps(args: TrainArgs, num_demos: int, num_samples: float, batch_size: int) -> int:
    """Number of gradient steps of a run.

    Args:
        args: Settings of the run.
        num_demos: Number of training episodes.
        num_samples: Number of samples in an epoch (`SequenceDataset`).
        batch_size: Number of samples in a gradient step of all processes.
    """
    if args.steps is not None:
        return args.steps
    epochs = PAPER_EPOCHS // num_demos if args.epochs is None else args.epochs
    return max(epochs * math.ceil(num_samples / batch_size), args.min_steps)
