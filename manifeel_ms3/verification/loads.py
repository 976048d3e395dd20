"""Known loads on a sensor: what was applied, what the sensor reports, and what a penalty field would report.

Sizes and loads are chosen, to cover what the tasks do to a pad.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.optimize import brentq
from trimesh.transformations import rotation_matrix

from manifeel_ms3.agents.panda_gelsight import GEL_STIFFNESS
from manifeel_ms3.sensors import TactileSensor, with_options
from manifeel_ms3.sensors.config import GelConfig

from .press import Press, indenter

BALL_RADIUS = 0.010
"""Radius of the ball, in m."""
PLACE = (1e-3, -2e-3)
"""Point of the pad over which objects are pressed, in m, so that nothing is symmetric."""
SHEAR_SHARES = (0.25, -0.15)
"""Shear along rows and columns as shares of the normal load; the gel's contact holds 0.65 of it."""
TWIST_ARM = 4e-4
"""Moment about the normal over the normal load, in m."""
PICTURED_LOAD = 10.0
"""Load under which images are taken, in N."""
LOOP_LOADS = (2.0, 4.0, 6.0, 8.0, 10.0)
"""Loads, in N, of the loop of loading and unloading, which begins and ends at 0."""
DEPTH_LOADS = (1.0, 3.0, 10.0)
"""Loads, in N, of a ball whose depth is compared with the law of the gel layer."""
MOST_SLIDING = 2e-3
"""Distance, in m, from which an object counts as having slid: the load then no longer acts where it was applied."""
HOUSING_SHARE = 0.9
"""Share of the gel's protrusion by which an object may press the gel in: beyond it, the housing would carry a part of
the load."""
FLAT_CONTACT_POINTS = 4
"""Number of contact points of PhysX between the gel and a shape that is not a ball."""
LOOP_SECONDS = 0.05
"""Time in which the load changes from one value of the loop to the next, in s."""
LAYER_POINTS = 401
"""Number of points along each side of the grid over which the law of the layer is summed."""
CLEARANCE = 2e-4
"""Height of an object over the pad before it is pressed, in m."""
SHAPES: dict[str, tuple[dict[str, Any], float]] = {
    "ball, 10 mm": (dict(radius=BALL_RADIUS), BALL_RADIUS),
    "ball, 6 mm": (dict(radius=0.006), 0.006),
    "rod, 6 mm": (dict(radius=0.006, half_length=0.006), 0.006),
    "box, 8 x 10 mm": (dict(half_size=[0.004, 0.005, 0.004]), 0.004),
    "plate, 12 x 16 mm": (dict(half_size=[0.006, 0.008, 0.004]), 0.004),
}
"""Indenters by name: arguments of `indenter`, and the height of the body's origin over the face when it touches, in m."""
KNOWN_LIMITS: dict[str, tuple[dict[str, Any], float, tuple[float, ...]]] = {
    "edge of a box": (
        dict(half_size=[0.006, 0.004, 0.004], rotation=rotation_matrix(np.pi / 4, [1, 0, 0])),
        0.004 * np.sqrt(2),
        (0.1, 0.3),
    ),
    "post, 4 mm": (
        dict(radius=0.004, half_length=0.004, rotation=rotation_matrix(np.pi / 2, [0, 1, 0])),
        0.004,
        (10.0,),
    ),
}
"""Shapes whose centre of pressure is reported less exactly, as in `SHAPES`, and the loads, in N, at which this happens.

The moment that the engine carries there would tilt the shape in the gel by more than the sensor allows, 5 degrees."""


@dataclass(frozen=True)
class Reading:
    """One load, and what the sensor reports of it.

    Loads (4,) are the normal force, the shear along rows and columns, N, and the moment about the normal, N m.
    """

    shape: str
    """Name of the shape that is pressed."""
    applied: np.ndarray
    """Load (4,) that pushes the object; its moment is about the pad's origin."""
    on_pad: np.ndarray
    """Load (4,) that the engine carries through the pad's joint."""
    reported: np.ndarray
    """Sums (4,) over the force field."""
    centre_error: float
    """Error of the field's centre of pressure, m: its distance from a ball's middle, and for other shapes from the centre of
    the force on the pad. Their tilt is locked, so that only the engine knows where its force acts."""
    penalty_sum: float
    """Sum of the normal components of the field with units="tacsl", m."""

    @property
    def is_ball(self) -> bool:
        """Whether the shape is a ball."""
        return _is_ball(self.shape)


@dataclass(frozen=True)
class TouchImages:
    """TacRGB and force field under one load."""

    shape: str
    """Name of the shape that is pressed."""
    rgb: np.ndarray
    """TacRGB image (H, W, 3) uint8."""
    force_field: np.ndarray
    """Force field (rows, cols, 3), N."""


@dataclass
class Measurements:
    """Everything that was measured on one sensor."""

    readings: list[Reading]
    """Readings of every shape under every load."""
    images: list[TouchImages]
    """Images of every shape."""
    loop: np.ndarray
    """Applied and reported normal force (n, 2), N, during loading and unloading."""
    depths: np.ndarray
    """Load, N, depth, and depth by the law of the layer, m, (n, 3), of a ball in the middle of the pad."""
    limits: list[Reading] = field(default_factory=list)
    """Readings of `KNOWN_LIMITS`."""
    left_out: list[str] = field(default_factory=list)
    """Loads that were left out, and why."""


def measure(
    sensor: str,
    loads: tuple[float, ...],
    tactile: Mapping[str, Any] | None = None,
    imperfections: Mapping[str, Any] | None = None,
    on_shape: Callable[[str], None] = lambda _name: None,
) -> Measurements:
    """Press the shapes on a sensor's simulated pad.

    Args:
        sensor: Name of the sensor.
        loads: Normal loads, N.
        tactile: Fields of the sensor's configuration to change, by dotted name.
        imperfections: Amounts of its imperfections, by name.
        on_shape: Function that is called with the name of each shape before it is pressed.

    Raises:
        UnknownNameError: The sensor, a field or an imperfection is unknown.
        InvalidArgumentError: A value is not allowed.
    """
    arguments: dict[str, Any] = dict(sensor=sensor, tactile=tactile, imperfections=imperfections)
    found = Measurements([], [], np.zeros((0, 2)), np.zeros((0, 3)))
    for name, (shape, touching) in SHAPES.items():
        on_shape(name)
        press = Press(indenter(name, **shape), **arguments)
        found.readings += _readings(press, name, touching, loads, found.left_out)
        found.images.append(_images(press, name, touching))
        if name.startswith("box"):
            found.loop = _loop(press, touching)
        if name == "ball, 10 mm":
            found.depths = _depths(press, name, touching, found.left_out)
        press.close()
    for name, (shape, touching, few) in KNOWN_LIMITS.items():
        press = Press(indenter(name, **shape), **arguments)
        found.limits += _readings(press, name, touching, few, found.left_out)
        press.close()
    return found


def _is_ball(name: str) -> bool:
    return name.startswith("ball")


def largest_load(press: Press, name: str) -> float:
    """Largest load, N, that the engine's gel carries: a ball has one contact point, and would reach the housing."""
    points = 1 if _is_ball(name) else FLAT_CONTACT_POINTS
    stiffness = GEL_STIFFNESS / 2 * points  # PhysX averages it with the other body's 0
    return HOUSING_SHARE * stiffness * press.sensor.config.housing.protrusion


def _readings(press: Press, name: str, touching: float, loads: tuple[float, ...], left_out: list[str]) -> Iterator[Reading]:
    config = with_options(press.sensor.config, {"units": "tacsl"})
    penalty = TactileSensor(config, press.env.scene, press.env.agent.robot, ("force_field",))
    for load in loads:
        if load > largest_load(press, name):
            left_out.append(f"{name} at {load:g} N: it would reach the housing")
            continue
        twist = 0.0 if _is_ball(name) else TWIST_ARM * load  # a ball on a point contact would spin
        press.place(touching + CLEARANCE, *PLACE)
        press.push(load, *(share * load for share in SHEAR_SHARES), twist=twist)
        if press.slid > MOST_SLIDING:
            left_out.append(f"{name} at {load:g} N: it slid by {1e3 * press.slid:.0f} mm in the engine")
            continue
        penalty.reset(torch.arange(1))
        penalty.capture()
        indented = penalty.get_obs()["force_field"][..., 0].sum().item()
        centre_error = press.ball_error if _is_ball(name) else press.centre_error
        yield Reading(name, press.applied, press.wrench, press.sums, centre_error, indented)


def _images(press: Press, name: str, touching: float) -> TouchImages:
    sensor = TactileSensor(press.sensor.config, press.env.scene, press.env.agent.robot)
    load = min(PICTURED_LOAD, largest_load(press, name))
    press.place(touching + CLEARANCE, *PLACE)
    press.push(load, *(share * load for share in SHEAR_SHARES))
    sensor.capture()
    return TouchImages(name, sensor.get_obs()["rgb"][0].cpu().numpy(), press.field)


def _loop(press: Press, touching: float) -> np.ndarray:
    press.place(touching + CLEARANCE, *PLACE)
    points = [(0.0, 0.0)]
    for load in (*LOOP_LOADS, *LOOP_LOADS[-2::-1], 0.0):
        press.push(load, seconds=LOOP_SECONDS)
        points.append((load, press.sums[0]))
    return np.array(points)


def _depths(press: Press, name: str, touching: float, left_out: list[str]) -> np.ndarray:
    rows, gel = [], press.sensor.config.gel
    for load in DEPTH_LOADS:
        if load > largest_load(press, name):
            left_out.append(f"the depth of {name} at {load:g} N: it would reach the housing")
            continue
        press.place(touching + CLEARANCE)
        press.push(load)
        rows.append((load, press.depth.max(), ball_depth(gel, BALL_RADIUS, press.wrench[0])))
    return np.array(rows).reshape(-1, 3)


def ball_depth(gel: GelConfig, radius: float, load: float) -> float:
    """Depth, m, to which a load presses a ball into the middle of the gel, by the law of the layer.

    The pressure is `gel.normal_stiffness` times the penetration, summed over a finer grid than the sensor's.

    Args:
        gel: The gel.
        radius: Radius of the ball, m.
        load: Normal load, N.
    """
    sides = [np.linspace(-extent / 2, extent / 2, LAYER_POINTS) for extent in gel.size]
    x, y = np.meshgrid(*sides, indexing="ij")
    area = np.prod([side[1] - side[0] for side in sides])
    r2 = x**2 + y**2
    gap = np.where(r2 < radius**2, radius - np.sqrt(np.maximum(radius**2 - r2, 0.0)) + gel.sag(x, y), np.inf)

    def excess(depth: float) -> float:
        return gel.normal_stiffness * area * np.maximum(depth - gap, 0.0).sum() - load

    under_ball = gap[np.isfinite(gap)]
    deepest = under_ball.max() + load / (gel.normal_stiffness * area * under_ball.size)  # where all of the ball carries
    root: Any = brentq(excess, 0.0, deepest)  # its annotation includes the full output, which is not requested
    return float(root)
