"""Training settings that several policies share."""

from dataclasses import replace
from typing import Any, TypeVar

from .encoders import EncoderConfig
from .train_args import TrainArgs

Args = TypeVar("Args", bound=TrainArgs)


def for_cpu(args: Args, inference_steps: int, **policy: Any) -> Args:
    """Settings for a small network that learns a task with narrow ranges on two CPU cores in minutes.

    The numbers are tuned on the task of `make demo`.

    Args:
        args: Settings of the paper.
        inference_steps: Number of generation steps in evaluation.
        **policy: Further fields of the policy's config.
    """
    small = replace(
        args.policy,
        action_horizon=2,  # of the 50 initial states of `make demo`, 36 succeed with 2, 28 with 4, 17 with 8
        obs_horizon=1,  # with 2, a policy infers the next action from its own motion and ignores the images
        encoder=EncoderConfig("small_cnn", "small_cnn", force_field="small", image_features=64, tactile_features=64, crop=76),
        down_dims=(64, 128, 256),
        diffusion_step_embed_dim=64,
        pose_noise=0.1,
        noise_draws=2,
        **policy,
    )
    return replace(
        args,
        policy=small,
        inference_steps=inference_steps,
        image_size=80,
        tactile_image_size=80,
        pose="rotation_6d",
        batch_size=64,
        steps=2000,
        lr=1e-3,
        warmup_steps=100,
        save_freq=1000,
        device="cpu",
        precision="fp32",
        compile=False,
    )
