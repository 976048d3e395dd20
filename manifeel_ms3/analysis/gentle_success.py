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
"""Ratio of the end of the force axis to the largest force that it must show."""
SHOWN = 0.95
"""Share of a panel's successes whose forces the axis must show; a few at ten times the limit would squeeze the others."""


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
    legend: dict[str, Any] = {}
    for ax, (task, (settings, conditions)) in zip(panels, overview.items(), strict=False):
        legend |= _draw_task(ax, found, conditions)
        ax.set_title(f"{task}, {settings.preset}")
    fig.suptitle("Success of Diffusion Policy up to a contact force")
    fig.legend(legend.values(), legend.keys(), fontsize=LEGEND_SIZE, ncols=len(legend), loc="outside lower center")
    for ax in panels[len(overview) :]:
        ax.set_axis_off()
    save_figure(fig, out, DPI)
    return True


def _draw_task(ax: Any, found: Found, by_mode: dict[str, Condition]) -> dict[str, Any]:
    """Draw the panel of a task, and return its lines by their names in the legend."""
    results = {mode: found[condition] for mode, condition in by_mode.items()}
    limits = {here.force_limit for here in results.values() if here.force_limit is not None}
    needed = [force for here in results.values() for force in _forces_of_successes(here)]
    shown = float(np.quantile(needed, SHOWN)) if needed else 0.0
    forces = np.linspace(0, MARGIN * max(1.0, shown, *limits), FORCES)
    lines = {}
    for mode, here in results.items():
        curve = success_under_force(here.episodes, forces)
        (lines[HEADINGS[mode]],) = ax.plot(forces, curve, drawstyle="steps-post", color=COLOURS[mode], lw=CURVE_WIDTH)
    for limit in limits:
        lines["limit of the task"] = ax.axvline(limit, color="black", ls="--", lw=1)
    ax.set(xlabel="contact force allowed, N", ylabel="success", xlim=(0, forces[-1]), ylim=(0, 1))
    return lines


def _forces_of_successes(results: ConditionResults) -> list[float]:
    """The largest force until each success of a condition, in N."""
    return [episode["force_until_success"] for episode in results.episodes if episode["success_once"]]
