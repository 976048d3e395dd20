"""The pictures of docs/tasks.md, made anew: `python -m docs.make_task_gallery` in the repository's root.

Every task once, late in its demonstration: the image for people, front, side and wrist camera, left and right pad.
"""

from pathlib import Path

import cv2
import gymnasium as gym
import numpy as np
from rich.progress import track

from manifeel_ms3.demonstrations.episode import demonstrate
from manifeel_ms3.experts import make_expert

from .make_task_cards import own_tasks

IMAGES = Path(__file__).parent / "images"
VIEWS = ("front", "side", "wrist", "tactile_left", "tactile_right")
MOMENT = 0.8  # of the demonstration
HEIGHT = 192  # pixels
QUALITY = 80  # of the file, which must stay below 400 kB
SEED = 1


def steps_of(task: str) -> int:
    """Length of the demonstration."""
    env = gym.make(task, obs_mode="none", render_backend="none")
    steps = demonstrate(env, task, SEED).info["elapsed_steps"]
    env.close()
    return steps


def moment(task: str) -> np.ndarray:
    """All views side by side."""
    steps = round(MOMENT * steps_of(task))
    env = gym.make(task, obs_mode="rgb+tacrgb", cameras=VIEWS[:3], tactile_sensors=("left", "right"), render_mode="rgb_array")
    obs, _ = env.reset(seed=SEED)
    for _, action in zip(range(steps), make_expert(task, env.unwrapped, SEED).actions(), strict=False):
        obs, *_ = env.step(action)
    pictures = [image[0].cpu().numpy() for image in (env.render(), *(obs["sensor_data"][view]["rgb"] for view in VIEWS))]
    env.close()
    return np.hstack(
        [cv2.resize(p, (round(HEIGHT * p.shape[1] / p.shape[0]), HEIGHT), interpolation=cv2.INTER_AREA) for p in pictures]
    )


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    rows = []
    for spec in track(own_tasks(), "tasks"):
        row = moment(spec.env_id)
        label = spec.name
        cv2.rectangle(row, (0, 0), (180, 24), (20, 20, 20), cv2.FILLED)
        cv2.putText(row, label, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)
        rows.append(row)
    cv2.imwrite(str(IMAGES / "tasks.jpg"), np.vstack(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
