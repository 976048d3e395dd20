"""The leaderboard as one HTML file that needs nothing else, and as a Markdown table."""

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import plotly.offline

from manifeel_ms3.analysis.markdown import markdown_table
from manifeel_ms3.analysis.protocol import LAST, Estimate, Runs, Setup, collect, setup_of, success
from manifeel_ms3.files import write_text

from .submission import Submission

PAGE, TABLE = "index.html", "README.md"
TEMPLATE = Path(__file__).with_name("page.html.j2")
FULL = (3, LAST, 50)  # the protocol's training seeds, checkpoints, starts


@dataclass(frozen=True)
class Row:
    """One set-up of one submission."""

    submission: Submission
    setup: Setup
    success: Estimate
    runs: Runs
    inference_ms: float
    force: float
    """N: the median episode's peak"""

    @property
    def is_full(self) -> bool:
        return all(have >= want for have, want in zip(self.runs.success.shape, FULL, strict=True))


def rows_of(submission: Submission) -> list[Row]:
    """Each set-up's success by the protocol."""
    rows = []
    for setup, runs in collect(submission.results.values()).items():
        episodes = [episode for result in _results(submission, setup) for episode in result["episodes"]]
        latency = float(np.median([episode["inference_ms"] for episode in episodes]))
        force = float(np.median([episode["peak_contact_force"] for episode in episodes]))
        rows.append(Row(submission, setup, success(runs), runs, latency, force))
    return rows


def _results(submission: Submission, setup: Setup) -> list[dict[str, Any]]:
    return [result for result in submission.results.values() if setup_of(result) == setup]


def ranked(submissions: list[Submission]) -> list[Row]:
    """Task by task, the best first."""
    rows = [row for submission in submissions for row in rows_of(submission)]
    return sorted(rows, key=lambda row: (row.setup.task, row.setup.variant, -row.success.value))


def table(rows: list[Row]) -> str:
    """Markdown."""
    head = (
        f"# Leaderboard\n\n`{PAGE}` is the same with filters, curves and films. Success is the mean over {FULL[0]} training "
        f"seeds, the last {FULL[1]} checkpoints and {FULL[2]} starts, with its interval of 95 %; what has fewer says so "
        'under "of".\n\n'
    )
    cells = []
    for row in rows:
        about, setup = row.submission.about, row.setup
        name = f"[{about.name}]({about.link})" if about.link else about.name
        task = f"{setup.task} {setup.variant}".strip()
        what = (setup.sensing, setup.policy, setup.network, setup.encoder, setup.num_demos)
        cells.append((task, *what, row.success, row.runs.size, name))
    names = ("task", "sensing", "policy", "network", "TacRGB encoder", "demonstrations", "success", "of", "submission")
    return head + markdown_table(names, cells)


def write(submissions: list[Submission], board: Path) -> Path:
    """Write the page and the table; returns the page."""
    rows = ranked(submissions)
    write_text(board / TABLE, table(rows))
    page = jinja2.Template(TEMPLATE.read_text(), autoescape=True).render(
        rows=[_for_page(row) for row in rows], full=FULL, plotly=jinja2.utils.markupsafe.Markup(plotly.offline.get_plotlyjs())
    )
    write_text(board / PAGE, page)
    return board / PAGE


def _for_page(row: Row) -> dict[str, Any]:
    results = _results(row.submission, row.setup)
    config = dict(sorted(results[-1]["config"].items()))
    link = row.submission.about.link
    return dict(
        task=row.setup.task,
        variant=row.setup.variant,
        sensing=row.setup.obs_mode,
        cameras=", ".join(row.setup.cameras),
        policy=row.setup.policy,
        network=row.setup.network,
        encoder=row.setup.encoder,
        demos=row.setup.num_demos or "",
        success=row.success,
        ran=row.runs.size,
        full=row.is_full,
        latency=row.inference_ms,
        force=row.force,
        name=row.submission.about.name,
        authors=row.submission.about.authors,
        link=link if link.startswith(("https://", "http://")) else "",
        config=json.dumps(config, indent=1),
        curves=json.dumps(_curves(row, results)),
        films=[base64.b64encode(path.read_bytes()).decode() for path in sorted(row.submission.folder.glob("videos/*.mp4"))],
    )


def _curves(row: Row, results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Success over gradient steps, one line a training seed, as plotly's traces."""
    traces = []
    for seed in sorted({result["training_seed"] for result in results}, key=str):
        points = sorted(
            (result["config"].get("step", 0), result["success_once"]["rate"])
            for result in results
            if result["training_seed"] == seed
        )
        steps, rates = zip(*points, strict=True)
        traces.append(dict(x=steps, y=[100 * rate for rate in rates], name=f"seed {seed}", mode="lines+markers"))
    return traces
