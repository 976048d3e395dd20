"""An HTML page about one run: `python -m manifeel_ms3.evaluation.report --run-dir runs/demo`.

Reads evaluation.json and log.jsonl, rolls one evaluated episode out again with every sensor on, and writes report.html: one
file that needs nothing else.
"""

import base64
import json
import logging
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import imageio.v2 as imageio
import jinja2
import numpy as np
import plotly.graph_objects as go
import torch
import tyro
from mani_skill.utils import common

import manifeel_ms3  # noqa: F401
from manifeel_ms3.sensors.visualisation import force_field_images

from .policy import load_policy
from .rollout import EpisodeOutcome, evaluate_episode

log = logging.getLogger(__name__)
STRIP_FRAMES = 8
TILE = 240  # pixels, height of a tile
TEMPLATE = Path(__file__).with_name("report.html.j2")


@dataclass
class Args:
    run_dir: Path
    """folder with evaluation.json, log.jsonl and checkpoints/last"""
    out: Path | None = None
    """page to write; default: report.html in run_dir"""


@dataclass
class Frame:
    """What was seen at one step, uint8 RGB pictures by name."""

    pictures: dict[str, np.ndarray]


def record_episode(result: dict[str, Any], checkpoint: Path) -> tuple[EpisodeOutcome, list[Frame]]:
    """Roll the first successful episode (or the first) of an evaluation out again, with every picture."""
    torch.set_num_threads(1)  # as in the evaluation: sums, and with them a rollout, depend on it
    seeds = [episode["seed"] for episode in result["episodes"] if episode["success_once"]]
    seed = (seeds or [result["episodes"][0]["seed"]])[0]
    cameras = tuple(dict.fromkeys([*result["env_kwargs"]["cameras"], "front"]))
    env = gym.make(result["env_id"], **result["env_kwargs"] | dict(obs_mode="rgb+tacrgb+tacff", cameras=cameras))
    frames: list[Frame] = []

    def keep(obs: dict[str, Any]) -> None:
        pictures = {}
        for name, data in obs["sensor_data"].items():
            title = name.replace("_", " ")
            pictures[title if name in cameras else f"{title}: TacRGB"] = common.to_numpy(data["rgb"])[0]
            if "force_field" in data:
                pictures[f"{title}: TacFF"] = common.to_numpy(force_field_images(data["force_field"]))[0]
        frames.append(Frame(pictures))

    outcome = evaluate_episode(env, load_policy(checkpoint), seed, keep)
    env.close()
    return outcome, frames


def _tile(picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    return cv2.resize(picture, (round(TILE * width / height), TILE), interpolation=cv2.INTER_AREA)


def strip(frames: list[Frame]) -> tuple[list[str], bytes]:
    """A PNG of some frames: time runs to the right, a row per sensor; and the rows' names."""
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, min(STRIP_FRAMES, len(frames))).round().astype(int)]
    names = list(chosen[0].pictures)
    rows = [np.concatenate([_square(frame.pictures[name]) for frame in chosen], axis=1) for name in names]
    png = cv2.imencode(".png", np.concatenate(rows)[..., ::-1])[1].tobytes()
    return names, png


def _square(picture: np.ndarray) -> np.ndarray:
    side = min(picture.shape[:2])
    top, left = ((n - side) // 2 for n in picture.shape[:2])
    return cv2.resize(picture[top : top + side, left : left + side], (160, 160), interpolation=cv2.INTER_AREA)


def video(frames: list[Frame], fps: int = 10) -> bytes:
    """An MP4 with all pictures side by side."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "episode.mp4"
        with imageio.get_writer(path, fps=fps, macro_block_size=8, quality=7) as writer:
            for frame in frames:
                writer.append_data(np.concatenate([_tile(picture) for picture in frame.pictures.values()], axis=1))
        return path.read_bytes()


def training_curve(log_file: Path) -> str:
    """The loss over gradient steps, as a plotly figure that needs no network."""
    entries = [entry for line in log_file.read_text().splitlines() if "loss" in (entry := json.loads(line))]
    figure = go.Figure(go.Scatter(x=[e["step"] for e in entries], y=[e["loss"] for e in entries], mode="lines"))
    figure.update_layout(
        xaxis_title="gradient step",
        yaxis_title="loss",
        yaxis_type="log",
        height=340,
        margin=dict(l=60, r=20, t=20, b=50),
    )
    return figure.to_html(full_html=False, include_plotlyjs=True)


def randomization_of(result: dict[str, Any]) -> dict[str, tuple[float, float]]:
    """The task's randomisation in this evaluation: {name: (value, the task's default)}."""
    env = gym.make(result["env_id"], **result["env_kwargs"] | dict(obs_mode="none", render_backend="none"))
    used, default = env.unwrapped.randomization, env.unwrapped.Randomization()
    env.close()
    return {name: (getattr(used, name), getattr(default, name)) for name in default.__dataclass_fields__}


def main(args: Args) -> Path:
    result = json.loads((args.run_dir / "evaluation.json").read_text())
    outcome, frames = record_episode(result, args.run_dir / "checkpoints/last")
    rows, picture = strip(frames)
    page = jinja2.Template(TEMPLATE.read_text(), autoescape=True).render(
        result=result,
        outcome=outcome,
        randomization=randomization_of(result),
        rows=rows,
        strip=base64.b64encode(picture).decode(),
        video=base64.b64encode(video(frames)).decode(),
        curve=jinja2.utils.markupsafe.Markup(training_curve(args.run_dir / "log.jsonl")),
    )
    out = args.out or args.run_dir / "report.html"
    out.write_text(page)
    log.info("%s", out)
    return out


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    main(tyro.cli(Args))
