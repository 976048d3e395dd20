"""An HTML page about one training run: `manifeel report --run-dir runs/demo`.

The page is made from evaluation.json and log.jsonl, and from one evaluated episode that is run again with every sensor. It is
one file, report.html, that needs nothing else. Its curve can be zoomed and hovered over, which plotly does in a page; the
figures of the documentation are static images, which matplotlib draws (`manifeel_ms3.analysis.results_page`).
"""

import base64
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro

from manifeel_ms3.arguments import require_file
from manifeel_ms3.command_line import missing_extras_named, run
from manifeel_ms3.files import read_json_lines, write_text
from manifeel_ms3.paths import CHECKPOINTS, EVALUATION, LAST_LINK
from manifeel_ms3.tasks.registry import task_spec

from .checkpoint_config import TRAINING_LOSS, CheckpointError, checkpoint_config
from .floors import floors_of
from .gentle import success_under_force
from .policy import INFERENCE_STEPS, PolicySource
from .result import is_of_config, read_result
from .variant import variant_of

with missing_extras_named():
    import jinja2
    import plotly.graph_objects as go
    from markupsafe import Markup

    from .video import Frame, encode_video, record_episode

STRIP_FRAMES = 8
"""Number of steps that the strip of images shows; set once, not tuned."""
STRIP_SIDE = 160
"""Width and height of an image in the strip, in pixels; report.html.j2 has the same height for the names of the rows."""
CURVE_HEIGHT = 340
"""Height of a figure, in pixels."""
CURVE_MARGINS = dict(l=60, r=20, t=20, b=50)
"""Left, right, upper and lower margin of a figure, in pixels."""
FORCE_MARGIN, FORCE_POINTS = 1.2, 601
"""Ratio of the end of the force axis to the largest force on it, and number of points of the curve."""
RATES = {
    "success_once": "success at any step",
    "success_at_end": "success at the end",
    "gentle_success": "gentle success",
    "success_paper": "success by the threshold of the paper's public code",
    "fail_once": "failure at any step",
    "fail_at_end": "failure at the end",
}
"""Rates of a result, and what the page calls them."""
TEMPLATE = Path(__file__).with_name("report.html.j2")


@dataclass
class Args:
    """Arguments of the report."""

    run_dir: Path
    """Folder of the training run, with evaluation.json, log.jsonl and the checkpoint that was evaluated."""
    out: Path | None = None
    """Path of the page; report.html in the run's folder if not given."""


def image_strip(frames: list[Frame]) -> tuple[list[str], bytes]:
    """The names of the sensors, and a PNG with one row of images for each; time runs to the right."""
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, min(STRIP_FRAMES, len(frames))).round().astype(int)]
    names = list(chosen[0])
    rows = [np.concatenate([_square(frame[name]) for frame in chosen], axis=1) for name in names]
    png = cv2.imencode(".png", np.concatenate(rows)[..., ::-1])[1].tobytes()
    return names, png


def _square(image: np.ndarray) -> np.ndarray:
    side = min(image.shape[:2])
    top, left = ((n - side) // 2 for n in image.shape[:2])
    return cv2.resize(image[top : top + side, left : left + side], (STRIP_SIDE, STRIP_SIDE), interpolation=cv2.INTER_AREA)


def force_curve(result: dict[str, Any]) -> str:
    """HTML of a plotly figure with the success against the contact force allowed, and the limit of the task."""
    limit, episodes = result.get("force_limit"), result["episodes"]
    reached = [episode["force_until_success"] for episode in episodes if episode["success_once"]]
    forces = np.linspace(0.0, FORCE_MARGIN * max([*reached, limit or 0.0, 1.0]), FORCE_POINTS)
    curve = go.Scatter(x=forces, y=100 * success_under_force(episodes, forces), mode="lines", line_shape="hv")
    figure = go.Figure(curve)
    if limit:
        figure.add_vline(
            x=limit, line_dash="dash", annotation_text=f"limit of the task, {limit:g} N", annotation_position="bottom left"
        )
    figure.update_layout(
        xaxis_title="contact force allowed, N",
        yaxis_title="success, %",
        yaxis_range=[0, 100],
        height=CURVE_HEIGHT,
        margin=CURVE_MARGINS,
    )
    return figure.to_html(full_html=False, include_plotlyjs=True)


def training_curve(log_file: Path) -> str:
    """HTML of a plotly figure with the loss over gradient steps; plotly itself must be on the page already."""
    entries = [entry for entry in read_json_lines(log_file) if TRAINING_LOSS in entry]
    figure = go.Figure(go.Scatter(x=[e["step"] for e in entries], y=[e[TRAINING_LOSS] for e in entries], mode="lines"))
    figure.update_layout(
        xaxis_title="gradient step",
        yaxis_title="loss",
        yaxis=dict(type="log", dtick="D2"),  # labels at 1, 2 and 5 of each decade; more of them would overlap
        height=CURVE_HEIGHT,
        margin=CURVE_MARGINS,
    )
    return figure.to_html(full_html=False, include_plotlyjs=False)


def randomization_of(result: dict[str, Any]) -> dict[str, tuple[float, float]]:
    """The task's randomization in an evaluation: pairs of the value there and the task's default, by the field's name."""
    kind: Any = task_spec(result["env_id"]).env_class.Randomization
    used, default = kind(**result["env_kwargs"].get("randomization") or {}), kind()
    return {name: (getattr(used, name), getattr(default, name)) for name in default.__dataclass_fields__}


def evaluated_checkpoint(path: Path, result: dict[str, Any]) -> Path:
    """The checkpoint, among those beside a result, that the result is of; training may have gone on to another one since.

    Args:
        path: Path of the result file.
        result: Its content.

    Raises:
        CheckpointError: There is no checkpoint of this step, or it is broken or of another training.
    """
    folder, step = path.parent / CHECKPOINTS, result["config"].get("step")
    last, found = folder / LAST_LINK, folder / Path(str(step)).name.zfill(8)
    if not found.is_dir() and checkpoint_config(last).get("step") == step:
        found = last
    if not found.is_dir():
        raise CheckpointError(
            f"{path} is of step {step}, whose checkpoint is not in {folder} any more; evaluate "
            f"another one with `manifeel eval --checkpoint {last}`"
        )
    if not is_of_config(result, checkpoint_config(found), but=(INFERENCE_STEPS,)):
        raise CheckpointError(
            f"{path} is of another training than {found}; evaluate it with `manifeel eval --checkpoint {found}`"
        )
    return found


def main(args: Args) -> Path:
    """Write the page, and return its path.

    Raises:
        ResultError: The run's evaluation.json is missing or broken.
        CheckpointError: The checkpoint of the evaluation is missing or broken.
        InvalidArgumentError: The page cannot be written to `args.out`.
        MachineError: This machine does not have the device of the evaluation.
    """
    result = read_result(evaluation := args.run_dir / EVALUATION)
    out = args.out or args.run_dir / "report.html"
    require_file("--out", out, "report.html")
    succeeded = [episode["seed"] for episode in result["episodes"] if episode["success_once"]]
    seed = (succeeded or [result["episodes"][0]["seed"]])[0]
    policy = PolicySource(evaluated_checkpoint(evaluation, result)).as_in(result).make()
    outcome, frames = record_episode(result["env_id"], result["env_kwargs"], policy, seed)
    rows, strip = image_strip(frames)
    page = jinja2.Template(TEMPLATE.read_text(), autoescape=True).render(
        result=result,
        outcome=outcome,
        rates={label: result[name] for name, label in RATES.items() if name in result},
        floors=floors_of(result["env_id"], result["revision"], variant_of(result["env_id"], result["env_kwargs"])),
        force_curve=Markup(force_curve(result)),
        randomization=randomization_of(result),
        rows=rows,
        strip=base64.b64encode(strip).decode(),
        video=base64.b64encode(encode_video(frames)).decode(),
        curve=Markup(training_curve(args.run_dir / "log.jsonl")),
    )
    write_text(out, page)
    return out


def next_step(_args: Args, made: Path) -> str:
    """What the command made, and what one can do with it."""
    return f"{made} is a page to open in a browser"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
