"""An HTML page about one run: `python -m manifeel_ms3.evaluation.report --run-dir runs/demo`.

Reads evaluation.json and log.jsonl, rolls one evaluated episode out again with every sensor on, and writes report.html: one
file that needs nothing else.
"""

import base64
import json
import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
import plotly.graph_objects as go
import tyro

from manifeel_ms3.command_line import run
from manifeel_ms3.tasks.registry import make_env

from .policy import load_policy
from .result import read_result
from .video import Frame, record_episode, video

log = logging.getLogger(__name__)
STRIP_FRAMES = 8
TEMPLATE = Path(__file__).with_name("report.html.j2")


@dataclass
class Args:
    run_dir: Path
    """folder with evaluation.json, log.jsonl and checkpoints/last"""
    out: Path | None = None
    """page to write; default: report.html in run_dir"""


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
    env = make_env(result["env_id"], **result["env_kwargs"] | dict(obs_mode="none", render_backend="none"))
    used, default = env.unwrapped.randomization, env.unwrapped.Randomization()
    env.close()
    return {name: (getattr(used, name), getattr(default, name)) for name in default.__dataclass_fields__}


def main(args: Args) -> Path:
    result = read_result(args.run_dir / "evaluation.json")
    won = [episode["seed"] for episode in result["episodes"] if episode["success_once"]]
    seed = (won or [result["episodes"][0]["seed"]])[0]
    policy = load_policy(args.run_dir / "checkpoints/last")
    outcome, frames = record_episode(result["env_id"], result["env_kwargs"], policy, seed)
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
    sys.exit(run(main, tyro.cli(Args)))
