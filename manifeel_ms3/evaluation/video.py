"""Videos of an episode, with the images of every camera and finger pad side by side."""

import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import imageio.v2 as imageio
import numpy as np

from manifeel_ms3.arguments import names_in
from manifeel_ms3.files import atomic_write
from manifeel_ms3.sensors.visualisation import observation_images
from manifeel_ms3.tasks.registry import make_env, task_spec
from manifeel_ms3.tasks.visuotactile_env import CONTROL_FREQ
from manifeel_ms3.workers import torch_threads

from .engine import Evaluation
from .policy import STEP_TIMEOUT, Policy
from .rollout import EpisodeOutcome, evaluate_episode

VIEWS = ("wrist", "front")
"""Cameras that every video shows, beside those of the policy."""
TILE_HEIGHT = 240
"""Height of each image in a video, in pixels: that of a TacRGB image."""
BLOCK = 8
"""Widths and heights of a video are made multiples of this number of pixels; H.264 needs an even number."""
QUALITY = 7
"""Quality of the encoding on imageio's scale from 0 to 10, at which text and touch stay sharp."""


Frame = dict[str, np.ndarray]
"""All images of one step: RGB (H, W, 3) uint8 by the names of their sensors."""


def act_again(
    env_id: str, env_kwargs: Mapping[str, Any], policy: Policy, seed: int, step_timeout: float = STEP_TIMEOUT
) -> tuple[EpisodeOutcome, list[np.ndarray]]:
    """Run an evaluated episode again; return its outcome and its actions (A,).

    The policy observes what it did in the evaluation and nothing else, so that any observation mode can be filmed. The images
    of a video come from a second run with the same actions.

    Args:
        env_id: Id of the task.
        env_kwargs: Arguments of `gym.make` in the evaluation.
        policy: The policy.
        seed: Seed of the episode.
        step_timeout: Longest time that the policy may take for one action, in s, after which the episode ends.
    """
    actions: list[np.ndarray] = []
    # one thread as in the evaluation: the rounding of sums, and so the episode, depends on their number
    with torch_threads(1), closing(make_env(env_id, **env_kwargs)) as env:
        return evaluate_episode(env, policy, seed, actions.append, step_timeout), actions


def write_video(evaluation: Evaluation, seed: int, folder: Path) -> None:
    """Run an episode again with every camera and touch, and write it into a folder as an MP4 file that is named by its seed."""
    policy = evaluation.source.make()
    _, frames = record_episode(evaluation.env_id, evaluation.env_kwargs, policy, seed, evaluation.step_timeout)
    with atomic_write(folder / f"{seed}.mp4") as partial_path:
        partial_path.write_bytes(encode_video(frames))


def film_env(
    env_id: str, env_kwargs: Mapping[str, Any], cameras: Iterable[str], pads: Iterable[str] = (), **others: Any
) -> gym.Env:
    """The environment of an episode with images of cameras, and of touch, in its observations.

    Args:
        env_id: Id of the task.
        env_kwargs: Arguments of `gym.make` with which the episode was recorded or evaluated.
        cameras: Cameras of the video, beside those of the episode.
        pads: Finger pads of the video, beside those of the episode; the right one if there is none at all.
        others: Further arguments of `gym.make`.

    Raises:
        MachineError: This machine has no renderer.
    """
    seen = names_in(env_kwargs.get("cameras")) or (task_spec(env_id).policy_camera,)
    added: dict[str, Any] = dict(
        obs_mode="rgb+tacrgb+tacff",
        cameras=tuple(dict.fromkeys([*seen, *cameras])),
        tactile_sensors=tuple(dict.fromkeys([*names_in(env_kwargs.get("tactile_sensors")), *pads])) or ("right",),
        render_backend="auto",
    )
    return make_env(env_id, **dict(env_kwargs) | added | others)


def replayed(env: gym.Env, actions: Iterable[np.ndarray], seed: int) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """The observations of an episode with given actions (A,), each with its `info`, from the reset to the last step."""
    yield env.reset(seed=seed)
    for action in actions:
        obs, *_, info = env.step(action)
        yield obs, info


def record_episode(
    env_id: str, env_kwargs: Mapping[str, Any], policy: Policy, seed: int, step_timeout: float = STEP_TIMEOUT
) -> tuple[EpisodeOutcome, list[Frame]]:
    """Run an evaluated episode again, and keep the images of every step.

    Args:
        env_id: Id of the task.
        env_kwargs: Arguments of `gym.make` in the evaluation; cameras and touch are added.
        policy: The policy.
        seed: Seed of the episode.
        step_timeout: Longest time that the policy may take for one action, in s, after which the episode ends.

    Raises:
        MachineError: This machine has no renderer.
    """
    outcome, actions = act_again(env_id, env_kwargs, policy, seed, step_timeout)
    with closing(film_env(env_id, env_kwargs, VIEWS)) as env:
        base: Any = env.unwrapped
        return outcome, [observation_images(obs, base.touch_full_scales) for obs, _ in replayed(env, actions, seed)]


def encode_video(frames: list[Frame]) -> bytes:
    """An MP4 file with the images of each step side by side, at the tasks' own control rate.

    Args:
        frames: Images of every step.
    """
    tiled = (np.concatenate([_tile(image) for image in frame.values()], axis=1) for frame in frames)
    return encode_mp4(tiled, CONTROL_FREQ, BLOCK)


def encode_mp4(images: Iterable[np.ndarray], fps: int, block: int) -> bytes:
    """An MP4 file with images as its frames.

    Args:
        images: RGB images (H, W, 3) uint8 of one size.
        fps: Frames per second.
        block: Number of pixels of which widths and heights are made multiples.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"  # imageio recognizes the format by the suffix
        writer: Any  # the stubs of imageio lack `append_data`
        with imageio.get_writer(path, fps=fps, macro_block_size=block, quality=QUALITY) as writer:
            for image in images:
                writer.append_data(image)
        return path.read_bytes()


def _tile(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    return cv2.resize(image, (round(TILE_HEIGHT * width / height), TILE_HEIGHT), interpolation=cv2.INTER_AREA)
