"""Gentle success of conditions: how many episodes succeed while the contact force stays under a limit."""

from pathlib import Path
from typing import Any

import numpy as np

from manifeel_ms3.command_line import missing_extras_named
from manifeel_ms3.evaluation.gentle import success_under_force

from .condition import Condition
from .figures import save_figure
from .matching import Found
from .paper_tables import COLOURS, DPI, HEADINGS, LEGEND_SIZE, overview_of_table_one
from .protocol import ConditionResults
from .success_curves import PANEL

COLUMNS = 3
"""Largest number of panels side by side."""
FORCES = 200
"""Number of points of a curve; set once, not tuned."""
CURVE_WIDTH = 1.8
"""Width of a curve, in points."""
MARGIN = 1.1
"""Ratio of the end of the force axis to the largest force that is drawn."""


def gentle_cell(results: ConditionResults) -> str | None:
    """The gentle success of a condition with the limit of its task, such as "46% up to 36 N"; None without a limit."""
    limit = results.force_limit
    return None if limit is None else f"{success_under_force(results.episodes, [limit])[0]:.0%} up to {limit:g} N"


def draw_success_under_force(found: Found, out: Path) -> bool:
    """Draw the success of Table I's conditions against the force allowed: a panel for each task, a curve for each sensing.

    `overview_of_table_one` says which settings a task has; tasks that were not run have no panel.

    Args:
        found: The results that enter comparisons.
        out: Path of the figure.

    Returns:
        Whether there is something to draw.

    Raises:
        MissingExtraError: The extra `report`, which draws, is not installed.
    """
    if not (overview := overview_of_table_one(found)):
        return False
    with missing_extras_named():
        from matplotlib.figure import Figure
    columns = min(len(overview), COLUMNS)
    rows = -(-len(overview) // columns)
    fig = Figure(figsize=(PANEL[0] * columns, PANEL[1] * rows), layout="constrained")
    panels = fig.subplots(rows, columns, squeeze=False).ravel()
    for ax, (task, (settings, conditions)) in zip(panels, overview.items(), strict=False):
        _draw_task(ax, found, conditions)
        ax.set_title(f"{task}: Diffusion Policy, {settings.preset}")
    for ax in panels[len(overview) :]:
        ax.set_axis_off()
    save_figure(fig, out, DPI)
    return True


def _draw_task(ax: Any, found: Found, by_mode: dict[str, Condition]) -> None:
    results = {mode: found[condition] for mode, condition in by_mode.items()}
    limits = {here.force_limit for here in results.values() if here.force_limit is not None}
    forces = np.linspace(0, MARGIN * max([1.0, *limits, *map(_largest_force, results.values())]), FORCES)
    for mode, here in results.items():
        curve = success_under_force(here.episodes, forces)
        ax.plot(forces, curve, drawstyle="steps-post", color=COLOURS[mode], label=HEADINGS[mode], lw=CURVE_WIDTH)
    for limit in limits:
        ax.axvline(limit, color="black", ls="--", lw=1, label=f"limit of the task, {limit:g} N")
    ax.set(xlabel="contact force allowed, N", ylabel="success", xlim=(0, forces[-1]), ylim=(0, 1))
    ax.legend(fontsize=LEGEND_SIZE, loc="upper left")


def _largest_force(results: ConditionResults) -> float:
    """The largest force that a success of a condition needed, in N; 0 without success."""
    return max((episode["force_until_success"] for episode in results.episodes if episode["success_once"]), default=0.0)
