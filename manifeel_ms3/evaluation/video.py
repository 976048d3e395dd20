"""Film an episode: what every camera and pad sees, side by side."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import imageio.v2 as imageio
import numpy as np
import torch

from manifeel_ms3.sensors.visualisation import pictures_of
from manifeel_ms3.tasks.registry import make_env

from .policy import Policy
from .rollout import EpisodeOutcome, evaluate_episode

TILE = 240  # pixels, height of a tile


@dataclass
class Frame:
    """What was seen at one step, uint8 RGB pictures by name."""

    pictures: dict[str, np.ndarray]


def record_episode(env_id: str, env_kwargs: dict[str, Any], policy: Policy, seed: int) -> tuple[EpisodeOutcome, list[Frame]]:
    """Roll an evaluated episode out again, with every picture."""
    torch.set_num_threads(1)  # as in the evaluation: sums, and with them a rollout, depend on it
    cameras = tuple(dict.fromkeys([*env_kwargs.get("cameras", ()), "wrist", "front"]))
    env = make_env(env_id, **env_kwargs | dict(obs_mode="rgb+tacrgb+tacff", cameras=cameras))
    frames: list[Frame] = []

    def keep(obs: dict[str, Any]) -> None:
        frames.append(Frame(pictures_of(obs)))

    outcome = evaluate_episode(env, policy, seed, keep)
    env.close()
    return outcome, frames


def _tile(picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    return cv2.resize(picture, (round(TILE * width / height), TILE), interpolation=cv2.INTER_AREA)


def video(frames: list[Frame], fps: int = 10) -> bytes:
    """An MP4 with all pictures side by side."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "episode.mp4"
        with imageio.get_writer(path, fps=fps, macro_block_size=8, quality=7) as writer:
            for frame in frames:
                writer.append_data(np.concatenate([_tile(picture) for picture in frame.pictures.values()], axis=1))
        return path.read_bytes()
