"""A training run of a tiny network in a process of its own, which can be killed at any moment.

The process is forked from a server that has imported everything, so that a start costs a fraction of a second.
"""

import dataclasses
import multiprocessing
import time
from pathlib import Path
from typing import Any

import torch

from baselines.common.checkpoint import TRAINING_STATE, WEIGHTS, read_tensors
from baselines.common.encoders import EncoderConfig
from baselines.common.train_args import TrainArgs
from baselines.diffusion_policy import train as diffusion
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config
from tests.sample import observed_sample

DEMOS = observed_sample("ManiFeel-PegInsertion-v1")
STEPS = 40
FORKING = multiprocessing.get_context("forkserver")
FORKING.set_forkserver_preload([__name__, "tensorboard.summary.writer.event_file_writer"])


def tiny_args(run_dir: Path | None, **changes: Any) -> TrainArgs:
    """Settings with a few milliseconds for each step, and a checkpoint at every second step."""
    paper = diffusion.PRESETS["paper"].args
    policy = dataclasses.replace(
        paper.policy, encoder=EncoderConfig(force_field="small"), down_dims=(8, 16), diffusion_step_embed_dim=8
    )
    run = dict(demos=(DEMOS,), obs_mode="tacff", cameras=(), policy=policy, run_dir=run_dir, num_demos=1, image_size=32)
    run |= dict(batch_size=4, steps=STEPS, warmup_steps=2, save_freq=2, keep=3, log_freq=1)
    return dataclasses.replace(paper, **run | changes, device="cpu", precision="fp32", compile=False)


def train(args: TrainArgs) -> Path:
    """Train in this process."""
    torch.set_num_threads(1)
    return diffusion.SPEC.train(args)


def start(args: TrainArgs) -> Any:
    """Train in another process."""
    process = FORKING.Process(target=train, args=(args,), daemon=True)
    process.start()
    return process


def finished(args: TrainArgs) -> float:
    """Train in another process to the end, and return how long it took, in s."""
    begin = time.monotonic()
    process = start(args)
    process.join()
    assert process.exitcode == 0
    return time.monotonic() - begin


def require_whole(checkpoint: Path) -> int:
    """Check that everything that evaluation and resuming need can be read, and return the step of the checkpoint."""
    assert read_tensors(checkpoint / WEIGHTS)
    assert read_tensors(checkpoint / TRAINING_STATE)
    step = checkpoint_config(checkpoint)["step"]
    assert checkpoint.resolve().name == f"{step:08d}"
    return step
