"""The leaderboard as one HTML file that needs nothing else, and as a Markdown table.

The page has plotly's figures, which a reader can zoom and hover over in a browser.
"""

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from manifeel_ms3.analysis.markdown import markdown_table
from manifeel_ms3.analysis.protocol import (
    LAST,
    Condition,
    ConditionResults,
    Estimate,
    collect,
    condition_of,
    mean_success,
)
from manifeel_ms3.command_line import missing_extras_named
from manifeel_ms3.files import write_text

from .submission import EPISODES, Submission

with missing_extras_named():
    import jinja2
    import plotly.offline
    from markupsafe import Markup

PAGE, TABLE = "index.html", "README.md"
TEMPLATE = Path(__file__).with_name("page.html.j2")
FULL = (3, LAST, EPISODES)
"""Numbers of training seeds, checkpoints and evaluation episodes in the paper's protocol."""


@dataclass(frozen=True)
class Row:
    """One condition of one submission."""

    submission: Submission
    condition: Condition
    success: Estimate
    results: ConditionResults
    inference_ms: float
    """Median over episodes of the mean time of an inference, in ms."""
    force: float
    """Median over episodes of the largest contact force, in N."""

    @property
    def is_full(self) -> bool:
        """Whether there are as many training seeds, checkpoints and episodes as in the paper's protocol."""
        return all(have >= want for have, want in zip(self.results.success.shape, FULL, strict=True))


def rows_of(submission: Submission) -> list[Row]:
    """The success of each condition of a submission, by the paper's protocol."""
    rows = []
    for condition, results in collect(submission.results.values()).items():
        episodes = [episode for result in _results(submission, condition) for episode in result["episodes"]]
        latency = float(np.median([episode["inference_ms"] for episode in episodes]))
        force = float(np.median([episode["peak_contact_force"] for episode in episodes]))
        rows.append(Row(submission, condition, mean_success(results), results, latency, force))
    return rows


def _results(submission: Submission, condition: Condition) -> list[dict[str, Any]]:
    return [result for result in submission.results.values() if condition_of(result) == condition]


def ranked(submissions: list[Submission]) -> list[Row]:
    """The rows of all submissions, sorted by task, and by success within a task, the highest first."""
    rows = [row for submission in submissions for row in rows_of(submission)]
    return sorted(rows, key=lambda row: (row.condition.task, row.condition.variant, -row.success.value))


def leaderboard_table(rows: list[Row]) -> str:
    """The leaderboard in Markdown."""
    head = (
        f"# Leaderboard\n\n`{PAGE}` shows the same with filters, learning curves and videos. Success is the mean over "
        f"{FULL[0]} training seeds, the last {FULL[1]} checkpoints and {FULL[2]} evaluation episodes, with its interval of "
        '95 %; where there are fewer, "of" says how many.\n\n'
    )
    cells = []
    for row in rows:
        about, condition = row.submission.about, row.condition
        name = f"[{about.name}]({about.link})" if about.link else about.name
        task = f"{condition.task} {condition.variant}".strip()
        what = (condition.sensing, condition.policy, condition.network, condition.encoder, condition.num_demos)
        cells.append((task, *what, row.success, row.results.size, name))
    names = ("task", "sensing", "policy", "network", "TacRGB encoder", "demonstrations", "success", "of", "submission")
    return head + markdown_table(names, cells)


def write_page(submissions: list[Submission], board: Path) -> Path:
    """Write the page and the table into the leaderboard's folder, and return the path of the page."""
    rows = ranked(submissions)
    write_text(board / TABLE, leaderboard_table(rows))
    page = jinja2.Template(TEMPLATE.read_text(), autoescape=True).render(
        rows=[_for_page(row) for row in rows], full=FULL, plotly=Markup(plotly.offline.get_plotlyjs())
    )
    write_text(board / PAGE, page)
    return board / PAGE


def _for_page(row: Row) -> dict[str, Any]:
    results = _results(row.submission, row.condition)
    config = dict(sorted(results[-1]["config"].items()))
    link = row.submission.about.link
    return dict(
        task=row.condition.task,
        variant=row.condition.variant,
        sensing=row.condition.obs_mode,
        cameras=", ".join(row.condition.cameras),
        policy=row.condition.policy,
        network=row.condition.network,
        encoder=row.condition.encoder,
        demos=row.condition.num_demos or "",
        success=row.success,
        size=row.results.size,
        full=row.is_full,
        latency=row.inference_ms,
        force=row.force,
        name=row.submission.about.name,
        authors=row.submission.about.authors,
        link=link if link.startswith(("https://", "http://")) else "",
        config=json.dumps(config, indent=1),
        curves=json.dumps(_curves(row, results)),
        videos=[base64.b64encode(path.read_bytes()).decode() for path in sorted(row.submission.folder.glob("videos/*.mp4"))],
    )


def _curves(row: Row, results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Success over gradient steps as plotly's traces, one line for each training seed."""
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
