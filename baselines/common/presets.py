"""Training settings that several policies share."""

from dataclasses import replace
from typing import Any, TypeVar

from .encoders import EncoderConfig
from .train_args import TrainArgs

Args = TypeVar("Args", bound=TrainArgs)
FINE = EncoderConfig("fine_cnn", "fine_cnn", force_field="small", image_features=64, tactile_features=64, crop=156)
"""Encoders of the small policies: with 160 pixels for the wrist camera's square of the work, a socket that is 1 mm wide can be
seen."""


def for_cpu(
    args: Args, inference_steps: int, encoder: EncoderConfig = FINE, image_size: int = 160, steps: int = 7000, **policy: Any
) -> Args:
    """Settings for small networks that learn a task with the paper's ranges and demonstrations on one CPU core in minutes.

    docs/trials.md has the measurements by which they were chosen.

    Args:
        args: Settings of the paper.
        inference_steps: Number of generation steps in evaluation.
        encoder: Networks that encode the observations.
        image_size: Height and width of camera images, pixels.
        steps: Number of gradient steps.
        **policy: Further fields of the policy's config.
    """
    small = replace(
        args.policy,
        action_horizon=4,  # ball sorting succeeds more often with 8, and insertion, which must react to contact, with 2
        obs_horizon=1,  # with 2, a policy infers the next action from its own motion and ignores the images
        encoder=encoder,
        action_network="mlp",  # a U-Net would take most of a step's time
        diffusion_step_embed_dim=64,  # features
        pose_noise=0.1,  # standard deviation, where the pose has the range [-1, 1]
        noise_draws=8,  # for each sample: the MLP costs little beside the encoders
        **policy,
    )
    return replace(
        args,
        policy=small,
        inference_steps=inference_steps,
        camera_view="work",
        image_size=image_size,
        tactile_image_size=96,  # pixels, height and width
        pose="rotation_6d",
        batch_size=16,  # samples; more steps of small batches were tried beside fewer steps of 64
        steps=steps,
        lr=1e-3,  # the paper's 8e-5 is for a hundred times as many steps
        warmup_steps=100,  # gradient steps
        save_freq=1000,  # gradient steps
        device="cpu",
        precision="fp32",
        compile=False,
    )


def in_epochs(small: Args, epochs: int = 30) -> Args:
    """Settings for small networks that learn long tasks for longer, with less noise on the pose.

    docs/trials.md has the trials in which the nut is learned far more often with them.

    Args:
        small: Settings that `for_cpu` has made, whose number of gradient steps becomes the smallest.
        epochs: Number of epochs.
    """
    assert small.steps is not None
    policy = replace(small.policy, pose_noise=0.03)  # standard deviation, where the pose has the range [-1, 1]
    return replace(small, policy=policy, steps=None, epochs=epochs, min_steps=small.steps)


def with_targets(args: Args) -> Args:
    """Settings with which a policy predicts the poses that the hand is to have, instead of its motions.

    docs/trials.md has the trials in which the USB plug is inserted far more often with them.

    Args:
        args: Settings of a training whose policy predicts motions.
    """
    return replace(args, policy=replace(args.policy, action_form="target", action_scale="root"))


def with_noisy_pose(args: Args) -> Args:
    """Settings with so much noise on the pose of the tool that a policy must take from the images where the work is.

    docs/trials.md has the trials in which the bulb is screwed in far more often with them.

    Args:
        args: Settings of a training.
    """
    policy = replace(args.policy, pose_noise=0.3)  # standard deviation, where the pose has the range [-1, 1]
    return replace(args, policy=policy, steps=8000)
