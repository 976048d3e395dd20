"""Settings that several policies share."""

from dataclasses import replace
from typing import Any, TypeVar

from .encoders import EncoderConfig
from .training import TrainArgs

Args = TypeVar("Args", bound=TrainArgs)


def for_cpu(args: Args, inference_steps: int, **policy: Any) -> Args:
    """A small network that learns a task with narrow ranges on two cores in minutes; `policy`: further fields of its config."""
    small = replace(
        args.policy,
        action_horizon=2,  # of 50 starts of `make demo` 36 succeed with 2, 28 with 4, 17 with 8
        obs_horizon=1,  # with two, its own motion tells a policy what to do next, and it stops looking
        encoder=EncoderConfig(image="small_cnn", tacrgb="small_cnn", force_field="small", crop=76),
        channels=(64, 128, 256),
        step_embedding=64,
        pose_noise=0.1,
        noise_draws=2,
        **policy,
    )
    sizes = dict(image_size=80, batch_size=64, steps=2000, lr=1e-3, warmup_steps=100, save_every=1000)
    return replace(args, policy=small, inference_steps=inference_steps, device="cpu", precision="fp32", compile=False, **sizes)
