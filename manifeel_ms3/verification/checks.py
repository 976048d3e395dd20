"""The bounds that a sensor must keep, and the worst measured value beside each.

The bounds are chosen: what users may rely on, not what the sensor reaches at best.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.sensors.config import OpticsConfig, TactileSensorConfig

from .loads import Measurements, Reading
from .published_colours import worst_similarity

FORCE_BOUND = 0.01
"""Largest relative error of the force field's sums."""
CENTRE_BOUND = 0.5e-3
"""Largest error of the centre of pressure, and of the moment over the load, in m."""
LOOP_BOUND = 0.01
"""Largest area between loading and unloading, as a share of the area under the loading curve."""
DEPTH_BOUND = 2e-5
"""Largest error of the depth of a ball, in m."""
SIMILARITY_BOUND = 0.90
"""Smallest structural similarity of the change images with those of a published calibration."""


@dataclass(frozen=True)
class Check:
    """One claim about a sensor, and whether it holds."""

    claim: str
    """What is compared with what."""
    worst: float
    """Worst value that was measured."""
    bound: float | None
    """Bound that the worst value must keep; None for a known limit, which is shown and not judged."""
    unit: str
    """Unit of both values."""
    at_least: bool = False
    """Whether the value must be at least the bound; otherwise at most."""

    @property
    def holds(self) -> bool:
        """Whether the bound is kept; NaN breaks it."""
        if self.bound is None:
            return True
        return bool(self.worst >= self.bound if self.at_least else self.worst <= self.bound)


def checks_of(found: Measurements, config: TactileSensorConfig) -> list[Check]:
    """The checks of a sensor; claims for which nothing was measured are left out.

    Args:
        found: Measurements on the sensor.
        config: Configuration of the sensor.

    Raises:
        InvalidArgumentError: The gel carries none of the loads.
    """
    if not found.readings:
        raise InvalidArgumentError(f"nothing was measured: {'; '.join(found.left_out)}; choose other --loads")
    normal = _worst([abs(r.reported[0] / r.applied[0] - 1) for r in found.readings])
    shear = _worst([np.abs(r.reported[1:3] - r.applied[1:3]).max() / r.applied[0] for r in found.readings])
    pad = _worst([np.abs(r.reported[:3] - r.on_pad[:3]).max() / r.applied[0] for r in found.readings])
    moment = _worst([abs(r.reported[3] - r.applied[3]) / r.applied[0] for r in found.readings])
    balls = [r.centre_error for r in found.readings if r.is_ball]
    others = [r.centre_error for r in found.readings if not r.is_ball]
    depth = np.abs(found.depths[:, 1] - found.depths[:, 2])
    checks = [
        Check("normal force: sum of the field against the load applied", 100 * normal, 100 * FORCE_BOUND, "%"),
        Check("shear: sums of the field against the load applied, of the normal load", 100 * shear, 100 * FORCE_BOUND, "%"),
        Check(
            "force: sums of the field against the force on the pad, of the normal load",
            100 * pad,
            100 * FORCE_BOUND,
            "%",
        ),
        Check("moment about the normal against the moment applied, over the load", 1e3 * moment, 1e3 * CENTRE_BOUND, "mm"),
        *_centre("centre of pressure of balls against the ball's middle", balls),
        *_centre("centre of pressure of box, plate and rod against the force on the pad", others),
        Check("loading and unloading: area of the loop", 100 * loop_area(found.loop), 100 * LOOP_BOUND, "%"),
    ]
    if len(depth):
        law = "depth of a ball against the law of the gel layer"
        checks.append(Check(law, 1e3 * float(depth.max()), 1e3 * DEPTH_BOUND, "mm"))
    if has_published_colours(config):
        similarity = Check(
            "colours against the published calibration, SSIM", worst_similarity(config), SIMILARITY_BOUND, "", True
        )
        checks.append(similarity)
    return checks + _known_limits(found.limits)


def _known_limits(readings: list[Reading]) -> list[Check]:
    """The errors of the centre of pressure for which there is no bound."""
    return [
        Check(f"known limit: centre of pressure, {r.shape} at {r.applied[0]:g} N", 1e3 * r.centre_error, None, "mm")
        for r in readings
    ]


def _worst(errors: list[float]) -> float:
    """The largest of some errors; NaN if one of them is NaN, which Python's `max` may pass over."""
    return float(np.max(errors))


def _centre(claim: str, errors: list[float]) -> list[Check]:
    """The check of errors of the centre of pressure, m, if there are any."""
    return [Check(claim, 1e3 * _worst(errors), 1e3 * CENTRE_BOUND, "mm")] if errors else []


def loop_area(loop: np.ndarray) -> float:
    """Area between loading and unloading as a share of the area under the loading curve.

    Args:
        loop: Applied and reported force (n, 2), N; the applied force rises to its largest value, and falls again.
    """
    top = int(loop[:, 0].argmax())
    up, down = loop[: top + 1], loop[top:]
    areas = [abs(float(np.sum(np.diff(part[:, 0]) * (part[1:, 1] + part[:-1, 1]) / 2))) for part in (up, down)]
    return abs(areas[1] - areas[0]) / areas[0]


def has_published_colours(config: TactileSensorConfig) -> bool:
    """Whether the sensor has the colours of the only published table at hand, that of the GelSight R1.5."""
    default = OpticsConfig()
    given = Path(config.optics.calibration).resolve()
    return config.optics.lights is None and given == Path(default.calibration).resolve()
