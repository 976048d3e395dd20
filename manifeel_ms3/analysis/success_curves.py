"""Success over the course of training, from the evaluations of a run's checkpoints: a figure, and a table as csv.

The figure's axis is the number of samples that training has seen: gradient steps times batch size times processes, so that
runs that differ in these can be compared. A sample begins at one recorded step of a demonstration, and is seen again in every
epoch; samples are therefore no environment steps.
"""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manifeel_ms3.command_line import missing_extras_named
from manifeel_ms3.evaluation.checkpoint_config import samples_per_step
from manifeel_ms3.evaluation.result import RATE_DECIMALS
from manifeel_ms3.files import write_text

from .condition import Condition, condition_of
from .estimates import Estimate, mean_success
from .figures import save_figure
from .presets import training_settings_of
from .protocol import collect

PANEL, DPI = (5.0, 3.4), 130
"""Width and height of a panel in inches, and resolution in pixels per inch."""
LEGEND_SIZE, LINE_WIDTH = 6, 1.5
"""Size of a legend's letters, and width of a curve, in points."""
BAND_OPACITY = 0.15
"""Opacity of the band of an interval, from 0 to 1, so that curves behind it are visible."""
HEADROOM = 0.02
"""Part of the axis of success that lies below 0 and above 1, so that curves at its ends are visible."""
COLUMNS = ("task", "variant", "sensing", "policy", "settings", "id", "gradient_steps", "samples_seen")
MEASURES = ("success", "low", "high", "training_seeds", "episodes")
"""Columns of the table: those that say what was trained, and those that say how often it succeeds."""


@dataclass(frozen=True)
class Point:
    """Success of a condition after some training."""

    gradient_steps: int
    """Number of gradient steps of the checkpoint."""
    samples_seen: int | None
    """Number of samples of all gradient steps; None if the configuration does not name the batch size."""
    success: Estimate
    """Success rate of the checkpoint."""
    training_seeds: int
    """Number of training seeds that were evaluated after so many steps."""
    episodes: int
    """Number of evaluation episodes of each training seed."""


def success_curves(results: Mapping[Path, dict[str, Any]]) -> dict[Condition, list[Point]]:
    """The success of each condition after each number of gradient steps that has results; two such numbers make a curve.

    Args:
        results: Contents of result files by their paths.

    Raises:
        ResultError: Two results are of the same checkpoint, or of different initial states.
    """
    by_step: dict[Condition, dict[int, dict[Path, dict[str, Any]]]] = {}
    for path, result in results.items():
        if isinstance(step := result["config"].get("step"), int):
            by_step.setdefault(condition_of(result), {}).setdefault(step, {})[path] = result
    return {
        condition: [_point(step, here) for step, here in sorted(steps.items())]
        for condition, steps in by_step.items()
        if len(steps) > 1
    }


def _point(step: int, results: dict[Path, dict[str, Any]]) -> Point:
    (evaluated,) = collect(results).values()
    samples = samples_per_step(next(iter(results.values()))["config"])
    seeds, _, episodes = evaluated.success.shape
    return Point(step, None if samples is None else step * samples, mean_success(evaluated), seeds, episodes)


def curve_table(curves: dict[Condition, list[Point]]) -> str:
    """The table of all curves as csv."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow((*COLUMNS, *MEASURES))
    for condition, points in curves.items():
        what = (
            condition.task,
            condition.variant,
            condition.sensing,
            condition.policy,
            str(training_settings_of(condition)),
            condition.key,
        )
        for point in points:
            success = [round(number, RATE_DECIMALS) for number in (point.success.value, point.success.low, point.success.high)]
            amount = (point.gradient_steps, point.samples_seen)
            writer.writerow((*what, *amount, *success, point.training_seeds, point.episodes))
    return out.getvalue()


def write_curves(results: Mapping[Path, dict[str, Any]], figure: Path, table: Path) -> bool:
    """Draw the curves, with one panel for each task, and write their table.

    Args:
        results: Contents of result files by their paths.
        figure: Path of the figure.
        table: Path of the csv file.

    Returns:
        Whether there is a curve; nothing is written without one.

    Raises:
        ResultError: Two results are of the same checkpoint, or of different initial states.
        MissingExtraError: The extra `report`, which draws, is not installed.
    """
    with missing_extras_named():
        from matplotlib.figure import Figure
        from matplotlib.ticker import EngFormatter

    curves = success_curves(results)
    if not curves:
        return False
    tasks: dict[str, list[Condition]] = {}
    for condition in sorted(curves, key=str):
        tasks.setdefault(condition.task, []).append(condition)
    fig = Figure(figsize=(PANEL[0] * len(tasks), PANEL[1]), layout="constrained")
    for ax, (task, conditions) in zip(fig.subplots(1, len(tasks), squeeze=False)[0], tasks.items(), strict=True):
        for condition in conditions:
            _draw(ax, condition, [point for point in curves[condition] if point.samples_seen is not None])
        ax.set(title=task, xlabel="samples seen in training", ylabel="success", ylim=(-HEADROOM, 1 + HEADROOM))
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))  # 400k
        ax.legend(fontsize=LEGEND_SIZE)
    save_figure(fig, figure, DPI)
    write_text(table, curve_table({condition: curves[condition] for here in tasks.values() for condition in here}))
    return True


def _draw(ax: Any, condition: Condition, points: list[Point]) -> None:
    seen = [point.samples_seen for point in points]
    label = ", ".join(
        filter(None, (condition.variant, condition.sensing, condition.policy, str(training_settings_of(condition))))
    )
    (line,) = ax.plot(seen, [point.success.value for point in points], label=label, lw=LINE_WIDTH, marker=".")
    lows, highs = zip(*((point.success.low, point.success.high) for point in points), strict=True) if points else ((), ())
    ax.fill_between(seen, lows, highs, color=line.get_color(), alpha=BAND_OPACITY, lw=0)
