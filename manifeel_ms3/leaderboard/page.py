"""The leaderboard as one HTML file that needs nothing else, and as a Markdown table.

The page has plotly's figures, which a reader can zoom and hover over in a browser.
"""

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from manifeel_ms3.analysis.condition import Condition, condition_of
from manifeel_ms3.analysis.estimates import Estimate, mean_success
from manifeel_ms3.analysis.markdown import markdown_table
from manifeel_ms3.analysis.presets import training_settings_of
from manifeel_ms3.analysis.protocol import LAST, ConditionResults, collect
from manifeel_ms3.command_line import missing_extras_named
from manifeel_ms3.evaluation.floors import Floor, highest_floor
from manifeel_ms3.evaluation.gentle import success_under_force
from manifeel_ms3.files import write_text
from manifeel_ms3.tasks.registry import task_spec
from manifeel_ms3.text import markdown_text, one_line

from .checks import EPISODES, submissions_on
from .rerun import episodes_to_run_again, rerun_of
from .submission import Submission

with missing_extras_named():
    import jinja2
    import plotly.offline
    from markupsafe import Markup

PAGE, TABLE = "index.html", "README.md"
"""Files of the leaderboard's page and of its table."""
TEMPLATE = Path(__file__).with_name("page.html.j2")
FULL = (3, LAST, EPISODES)
"""Numbers of training seeds, checkpoints and evaluation episodes in the paper's protocol."""


@dataclass(frozen=True)
class Row:
    """One condition of one submission."""

    submission: Submission
    condition: Condition
    success: Estimate
    """Mean success with its interval."""
    results: ConditionResults
    """Success in every episode."""
    files: dict[Path, dict[str, Any]]
    """Contents of the result files of the condition, by their paths in the submission."""
    inference_ms: float
    """Median over episodes of the mean time of an inference, in ms."""
    force: float
    """Median over episodes of the largest contact force, in N."""
    gentle: float | None
    """Share of the episodes that succeed gently; None for a task without a limit of force."""
    floor: Floor | None
    """Highest success of policies that have learnt nothing, where it is known."""
    rerun: tuple[int, int]
    """Numbers of episodes that the leaderboard ran again, and of all episodes."""

    @property
    def deviation_text(self) -> str:
        """Standard deviation of the success over training seeds; "" for a single one."""
        return "" if self.results.seed_deviation is None else f"{self.results.seed_deviation:.0%}"

    @property
    def rerun_text(self) -> str:
        """How many of the episodes were run again, such as "43 of 1500"."""
        run, total = self.rerun
        return f"{run} of {total}" if run else "no"

    @property
    def is_confirmed(self) -> bool:
        """Whether enough episodes were run again to detect invented outcomes."""
        run, total = self.rerun
        return run >= episodes_to_run_again(total)

    @property
    def is_full(self) -> bool:
        """Whether there are as many training seeds, checkpoints and episodes as in the paper's protocol."""
        return all(have >= want for have, want in zip(self.results.success.shape, FULL, strict=True))


def rows_of(submission: Submission) -> list[Row]:
    """The success of each condition of a submission, by the paper's protocol."""
    rows, by_condition = [], dict[Condition, dict[Path, dict[str, Any]]]()
    for path, result in submission.results.items():
        by_condition.setdefault(condition_of(result), {})[path] = result
    for condition, results in collect(submission.results).items():
        files, episodes = by_condition[condition], results.episodes
        latency = float(np.median([episode["inference_ms"] for episode in episodes]))
        force = float(np.median([episode["peak_contact_force"] for episode in episodes]))
        limit, rerun = task_spec(condition.env_id).force_limit, rerun_of(submission, files)
        gentle = None if limit is None else float(success_under_force(episodes, [limit])[0])
        floor = highest_floor(condition.env_id, condition.revision, condition.variant)
        measured = (latency, force, gentle, floor, rerun)
        rows.append(Row(submission, condition, mean_success(results), results, files, *measured))
    return rows


def rows_on(board: Path) -> list[Row]:
    """The rows of all submissions in a leaderboard's folder; a broken submission is named in the log, and left out."""
    return ranked([row for submission in submissions_on(board) for row in rows_of(submission)])


def ranked(rows: list[Row]) -> list[Row]:
    """The rows sorted by task, and by success within a task, the highest first."""
    return sorted(rows, key=lambda row: (row.condition.task, row.condition.variant, -row.success.value))


def leaderboard_table(rows: list[Row]) -> str:
    """The leaderboard in Markdown."""
    head = (
        f"# Leaderboard\n\n`manifeel leaderboard build` writes this table, and `{PAGE}`, which shows the "
        f"same with filters, learning curves and videos. Success is the mean over {FULL[0]} training seeds, the last {FULL[1]} "
        f"checkpoints and {FULL[2]} evaluation episodes, with its 95 % interval; where there are fewer, "
        '"of" gives their numbers. "At the end" is the share of the episodes in which the task is solved at the last step. '
        "A success is gentle if the contact force stays within the limit of the task until then "
        '([limits](../docs/evaluation.md#what-is-measured)). "Std" is the standard deviation over training seeds; "floor" is '
        'the success of policies that have learnt nothing, where it was measured. "Run again" is the number of episodes that '
        "the leaderboard ran again with the same outcome "
        "([what this proves](../docs/submitting.md#what-running-episodes-again-proves)). The page of "
        "[results](../docs/results.md) also has training seeds whose checkpoints were not kept. They are missing here, so that "
        'its rates differ where "of" says fewer than three training seeds.\n\n'
    )
    cells = []
    for row in rows:
        about, condition = row.submission.about, row.condition
        name = markdown_text(about.name)
        task = f"{condition.task} {condition.variant}".strip()
        gentle, at_end = ("" if rate is None else f"{rate:.0%}" for rate in (row.gentle, row.results.success_at_end))
        what = (task, condition.sensing, condition.policy, str(training_settings_of(condition)), condition.encoder)
        success = (row.success, at_end, row.deviation_text, row.floor or "", gentle)
        numbers = (condition.num_demos, *success, row.results.size, row.rerun_text)
        cells.append((*map(markdown_text, what), *numbers, f"[{name}]({about.link})" if about.link else name))
    what = ("task", "sensing", "policy", "settings", "TacRGB encoder", "demonstrations")
    measured = ("success", "at the end", "std", "floor", "gentle success", "of", "run again", "submission")
    return head + markdown_table((*what, *measured), cells)


def leaderboard_page(rows: list[Row]) -> str:
    """The leaderboard as one file of HTML, which links the results beside it."""
    template = jinja2.Template(TEMPLATE.read_text(encoding="utf-8"), autoescape=True)
    return template.render(rows=[_for_page(row) for row in rows], full=FULL, plotly=Markup(plotly.offline.get_plotlyjs()))


def write_page(rows: list[Row], board: Path) -> Path:
    """Write the page and the table into the leaderboard's folder, and return the path of the page."""
    write_text(board / TABLE, leaderboard_table(rows))
    write_text(board / PAGE, leaderboard_page(rows))
    return board / PAGE


def _for_page(row: Row) -> dict[str, Any]:
    about, condition, results = row.submission.about, row.condition, [*row.files.values()]
    texts = dict(
        task=condition.task,
        variant=condition.variant,
        sensing=condition.obs_mode,
        cameras=", ".join(condition.cameras),
        policy=condition.policy,
        setup=str(training_settings_of(condition)),
        encoder=condition.encoder,
        name=about.name,
        authors=about.authors,
    )
    return {name: one_line(text) for name, text in texts.items()} | dict(
        demos=condition.num_demos or "",
        success=row.success,
        at_end=row.results.success_at_end,
        deviation=row.deviation_text,
        floor=row.floor,
        size=row.results.size,
        full=row.is_full,
        rerun=row.rerun_text,
        confirmed=row.is_confirmed,
        latency=row.inference_ms,
        force=row.force,
        gentle=row.gentle,
        link=about.link,
        config=json.dumps(dict(sorted(results[-1]["config"].items())), indent=1),
        curves=json.dumps(_curves(results)),
        steps=row.results.success.shape[1],
        videos=[base64.b64encode(video).decode() for video in row.submission.videos_of(row.files)],
    )


def _curves(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
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
