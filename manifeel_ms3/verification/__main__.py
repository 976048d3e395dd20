"""Verify a tactile sensor: `manifeel verify-sensor gelsight_r15 --report sensor.html`.

Objects are pressed on the simulated pad by known loads, and one page shows what the sensor reports: applied against reported
force, centre of pressure, shear, hysteresis, depth, and the worst case of each beside its bound. The exit code is not 0 if a
bound is broken.
"""

import base64
import io
import json
import logging
import sys
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import tyro

from manifeel_ms3.arguments import is_number, require_file
from manifeel_ms3.command_line import json_object, missing_extras_named, run
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.files import write_text
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.provenance import git_commit, machine, package_versions
from manifeel_ms3.sensors.imperfection_config import FULL_SCALE_FORCE
from manifeel_ms3.sensors.registry import DEFAULT_SENSOR, task_sensor
from manifeel_ms3.sensors.visualisation import force_field_images

from .checks import Check, checks_of
from .loads import SHAPES, Measurements, measure

with missing_extras_named():
    import jinja2
    from markupsafe import Markup

log = logging.getLogger(__name__)
TEMPLATE = Path(__file__).with_name("page.html.j2")
COLOURS = ("#3a74c7", "#c7793a", "#4a9a5b", "#9a4a8f", "#8a8f98")
"""Colours of the shapes in the figure; chosen by eye."""
FIGURE_SIZE = (12.0, 7.5)
"""Width and height of the figure, in inches; chosen by eye."""
DOT, THIN, MIDDLE, LEGEND, SMALL_LEGEND = 4, 0.6, 0.8, 8, 7
"""Size of dots, widths of reference lines and of the law of the layer, and sizes of the legends' text, in points; by eye."""
LEAST_FORCE, LEAST_DISTANCE = 1e-6, 1e-8
"""Smallest force, in N, and distance, in m, that are drawn on logarithmic axes, which cannot show 0."""


@dataclass
class Args:
    """Verify a tactile sensor by known loads."""

    sensor: tyro.conf.Positional[str] = DEFAULT_SENSOR
    """Name of the sensor: gelsight_r15, gelsight_mini, digit, or one that another package registers."""
    report: Path = Path("sensor.html")
    """Path of the page that is written."""
    tactile: str = "{}"
    """Fields of the sensor's configuration to change, as json by dotted name, such as '{"gel.thickness": 0.003}'."""
    imperfections: str = "{}"
    """Amounts of the sensor's imperfections, as json by name."""
    loads: tuple[float, ...] = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
    """Normal loads in N. A ball, which has one contact point, is pressed only by loads that the gel can carry there."""


def main(args: Args) -> int:
    """Verify a sensor, write the page, and return the number of bounds that are broken.

    Raises:
        UnknownNameError: The sensor, a field or an imperfection is unknown.
        InvalidArgumentError: A value is not allowed, or the force field holds no forces.
        MissingExtraError: The extra `report` is not installed.
        FileWriteError: The page cannot be written.
    """
    with missing_extras_named():
        import matplotlib as _  # noqa: F401  (fails before the first load if it is missing)
    tactile, imperfections = json_object("--tactile", args.tactile), json_object("--imperfections", args.imperfections)
    if not args.loads or not all(is_number(load) and load > 0 for load in args.loads):
        raise InvalidArgumentError(f"--loads {args.loads} must be positive forces in N, such as 1 10")
    require_file("--report", args.report, "sensor.html")
    config = task_sensor(args.sensor, "tactile_right", "gel_right", tactile, imperfections)
    if config.units != "newton":
        raise InvalidArgumentError(
            f"--tactile {args.tactile}: a force field with units={config.units!r} holds no forces, and cannot be compared with "
            "loads; leave the units out: the first figure shows that field, too"
        )
    with progress_bar() as bar:
        task = bar.add_task("pressing", total=len(SHAPES))

        def on_shape(name: str) -> None:
            bar.update(task, advance=1, description=f"pressing the {name}")

        found = measure(args.sensor, args.loads, tactile, imperfections, on_shape)
    checks = checks_of(found, config)
    write_text(args.report, page(args.sensor, tactile | imperfections, found, checks))
    for check in checks:
        log.info("%s", _line(check))
    return sum(not check.holds for check in checks)


def _line(check: Check) -> str:
    """A check as one line of text."""
    measured = f"{check.claim}: {check.worst:.3g} {check.unit}"
    if check.bound is None:
        return measured
    return f"{'ok    ' if check.holds else 'BROKEN'} {measured} ({'at least' if check.at_least else 'at most'} {check.bound:g})"


def page(sensor: str, changes: dict[str, Any], found: Measurements, checks: list[Check]) -> str:
    """The page as HTML that needs no other file.

    Args:
        sensor: Name of the sensor.
        changes: Changed fields and imperfections of the sensor, by name.
        found: Measurements.
        checks: Checks of the measurements.
    """
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(
        TEMPLATE.read_text(encoding="utf-8")
    )
    return template.render(
        sensor=sensor,
        changes=json.dumps(changes) if changes else "",
        date=datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        versions=package_versions(),
        commit=git_commit(),
        machine=machine(),
        checks=checks,
        figure=Markup(figure(found)),
        strip=_strip(found),
        names=[touch.shape for touch in found.images],
        readings=found.readings + found.limits,
        left_out=found.left_out,
    )


def _strip(found: Measurements) -> str:
    """TacRGB over force field of every shape, as a PNG in base64."""
    columns = []
    for touch in found.images:
        height, width = touch.rgb.shape[:2]
        field = force_field_images(torch.as_tensor(touch.force_field)[None], FULL_SCALE_FORCE, (height, width))[0].numpy()
        columns.append(np.vstack([touch.rgb, field]))
    return base64.b64encode(cv2.imencode(".png", np.hstack(columns)[..., ::-1])[1].tobytes()).decode()


def figure(found: Measurements) -> str:
    """The measurements as an SVG."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=FIGURE_SIZE, layout="constrained")
    axes = drawn.subplots(2, 3)
    _draw_forces(axes[0, 0], found)
    for name, colour in zip(SHAPES, COLOURS, strict=True):
        rows = [reading for reading in found.readings if reading.shape == name]
        load = [reading.applied[0] for reading in rows]
        errors = [1e3 * max(reading.centre_error, LEAST_DISTANCE) for reading in rows]
        axes[0, 1].loglog(load, errors, "o-", color=colour, label=name)
        for k, mark in ((1, "o"), (2, "s")):
            axes[0, 2].plot([r.applied[k] for r in rows], [r.reported[k] for r in rows], mark, color=colour, ms=DOT)
        axes[1, 0].plot([1e3 * r.applied[3] for r in rows], [1e3 * r.reported[3] for r in rows], "o", color=colour, ms=DOT)
    axes[0, 1].set(title="centre of pressure", xlabel="normal load, N", ylabel="distance, mm")
    axes[0, 2].set(title="shear: rows (dots), columns (squares)", xlabel="applied, N", ylabel="reported, N")
    axes[1, 0].set(title="moment about the normal", xlabel="applied, N mm", ylabel="reported, N mm")
    for axis in (axes[0, 2], axes[1, 0]):
        axis.axline((0, 0), slope=1, color="black", lw=THIN)
    top = int(found.loop[:, 0].argmax())
    axes[1, 1].plot(*found.loop[: top + 1].T, "o-", color=COLOURS[0], label="loading")
    axes[1, 1].plot(*found.loop[top:].T, "s--", color=COLOURS[1], label="unloading")
    axes[1, 1].set(title="loading and unloading", xlabel="applied, N", ylabel="reported, N")
    axes[1, 2].plot(found.depths[:, 0], 1e3 * found.depths[:, 1], "o", color=COLOURS[0], label="sensor")
    axes[1, 2].plot(found.depths[:, 0], 1e3 * found.depths[:, 2], "-", color="black", lw=MIDDLE, label="law of the layer")
    axes[1, 2].set(title="depth of the ball", xlabel="normal load, N", ylabel="depth, mm")
    for axis in (axes[1, 1], axes[1, 2]):
        axis.legend(fontsize=LEGEND)
    text = io.StringIO()
    drawn.savefig(text, format="svg")
    return text.getvalue()[text.getvalue().index("<svg") :]


def _draw_forces(axis: Any, found: Measurements) -> None:
    """Draw reported against applied normal force, and the sums of the penalty field, scaled to newtons by one common factor."""
    pairs = [(r.penalty_sum, r.applied[0]) for r in found.readings if r.penalty_sum > 0]
    scale = float(np.exp(np.mean([np.log(load / indented) for indented, load in pairs]))) if pairs else 1.0
    for name, colour in zip(SHAPES, COLOURS, strict=True):
        rows = [reading for reading in found.readings if reading.shape == name]
        load = [reading.applied[0] for reading in rows]
        axis.loglog(load, [max(reading.reported[0], LEAST_FORCE) for reading in rows], "o", color=colour, label=name)
        axis.loglog(load, [max(scale * reading.penalty_sum, LEAST_FORCE) for reading in rows], ":", color=colour, lw=1)
    axis.axline((1, 1), (10, 10), color="black", lw=THIN)
    axis.set(title='normal force; dotted: units="tacsl", scaled', xlabel="applied, N", ylabel="sum of the field, N")
    axis.legend(fontsize=SMALL_LEGEND)


def next_step(args: Args, broken: int) -> str:
    """Sentence about what the command has made, and what one can do with it."""
    tasks = f"`manifeel record TASK --sensor {args.sensor}` records with this sensor"
    outcome = "its broken bounds say what to change in the sensor" if broken else f"every bound holds, and {tasks}"
    return f"{args.report} is a page to open in a browser; {outcome}"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
