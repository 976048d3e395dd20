"""Measures the tactile sensor's milliseconds per pad, alone and in batches, and compares its optics with a table look-up.

Run `python benchmarks/tactile_speed.py` in the repository's root.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import torch
import trimesh
import tyro
from rich.console import Console
from rich.table import Table

import manifeel_ms3  # noqa: F401
from manifeel_ms3.sensors import TactileSensor, TactileSensorConfig, gelsight_r15, sensor_config, with_options
from manifeel_ms3.sensors.depth.raycast import MeshRays
from manifeel_ms3.sensors.optics.shader import KNOTS, Shader, fourier_terms, slope_terms
from manifeel_ms3.sensors.touch_model import TouchModel
from manifeel_ms3.sensors.warp_device import use_torch_threads_for_warp

MODES = {  # outputs and options of the sensor, by name
    "TacFF": (("force_field",), {}),
    "TacRGB": (("rgb",), {}),
    "TacRGB + TacFF": (("rgb", "force_field"), {}),
    "and shadow, noise, dots": (
        ("rgb", "force_field"),
        {"optics.shadow": 0.5, "optics.noise": 2.0, "optics.markers": True},
    ),
    "TacRGB + TacFF, imperfect": (
        ("rgb", "force_field"),
        {f"imperfections.{name}": 0.1 for name in ("hysteresis", "crosstalk", "dead_taxels", "drift", "noise", "gain")}
        | {"imperfections.delay": 2},
    ),
}
PUSH = (0.5, 0.2, -5.0, 0.0, 0.0, 1e-3)  # wrench on each pad, N and N m
TABLE_BINS = 125  # number of bins of each axis in TacSL's tables


@dataclass
class Args:
    sensors: tuple[str, ...] = ("gelsight_r15", "gelsight_mini", "digit")
    """Sensors by name."""
    batches: tuple[int, ...] = (1, 8, 64)
    """Numbers of pads that are computed at once."""
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    """Device on which the sensor runs."""
    seconds: float = 2.0
    """Duration of each measurement, s."""


def press(config: TactileSensorConfig, shape: trimesh.Trimesh, pads: int, device: torch.device) -> MeshRays:
    """Rays of equal pads, each with the shape half a millimetre deep in its gel."""
    rays = MeshRays([[shape] * pads], config.gel.size, device, config.gel.max_sag)
    deep = torch.tensor([0.0, 0, -5e-4, 0, 0, 0, 1], device=device)
    rays.move(deep.expand(pads, 1, 7), torch.tensor([0.0, 0, 0, 0, 0, 0, 1], device=device).expand(pads, 7))
    return rays


def shapes() -> dict[str, trimesh.Trimesh]:
    """Meshes over the face by name, their lowest point at height zero, m."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.008)
    plate = trimesh.creation.box([0.012, 0.024, 0.01])
    return {
        "ball, 20,480 triangles": ball.apply_translation([0, 0, 0.008]),
        "plate over 37 %": plate.apply_translation([0, 0, 0.005]),
    }


def milliseconds(function: Callable, seconds: float) -> float:
    """Mean duration of a call."""
    synchronise = torch.cuda.synchronize if torch.cuda.is_available() else lambda: None
    for _ in range(3):
        function()
    synchronise()
    calls, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        function()
        calls += 1
    synchronise()
    return 1e3 * (time.perf_counter() - begin) / calls


def table_lookup(surface: np.ndarray, table: np.ndarray, background: np.ndarray, pixel_size: float) -> np.ndarray:
    """The plain method (Taxim, TacSL): blur, gradient, bins, and a sum over six coefficients per channel and pixel."""
    height = cv2.GaussianBlur(surface / pixel_size, (5, 5), 0)
    along_rows, along_cols = np.gradient(height)
    slope, direction = np.arctan(np.hypot(along_rows, along_cols)), np.arctan2(along_rows, along_cols)
    i = np.floor(slope / (np.pi / 2 / (TABLE_BINS - 1))).astype(int)
    j = np.floor((direction + np.pi) / (2 * np.pi / (TABLE_BINS - 1))).astype(int)
    x, y = np.meshgrid(np.arange(surface.shape[1]), np.arange(surface.shape[0]))
    terms = np.stack([x * x, y * y, x * y, x, y, np.ones_like(x)], axis=-1)
    change = [(channel[i, j] * terms).sum(-1) for channel in table]
    return (np.stack(change, axis=-1) + background).clip(0, 255).astype(np.uint8)


def any_table() -> np.ndarray:
    """Look-up table (3, bins, bins, 6) of a realistic size; its colours do not matter for the speed."""
    shader = Shader.load(gelsight_r15("touch", "gel_right").optics.calibration)
    slope, phi = np.linspace(0, np.pi / 2, TABLE_BINS), np.linspace(-np.pi, np.pi, TABLE_BINS)
    gradient = np.tan(slope.clip(max=np.arctan(KNOTS[-1])))
    return np.einsum("cfkq,sk,pf->cspq", shader.weights, slope_terms(gradient), fourier_terms(phi))


def sensor_table(name: str, args: Args, device: torch.device) -> Table:
    """Milliseconds per pad of one sensor: alone, in batches, in an environment, and at a reset."""
    table = Table("touches", "gives", *(f"{n} at once" for n in args.batches), title=f"{name}: ms per pad")
    config = sensor_config(name, "touch", "gel_right")
    for shape_name, shape in shapes().items():
        for label, (outputs, options) in MODES.items():
            times = []
            for n in args.batches:
                model = TouchModel(with_options(config, options), n, device, outputs)
                rays = press(config, shape, n, device)
                wrench = torch.tensor(PUSH, dtype=torch.float64, device=device).repeat(n, 1)
                times.append(milliseconds(lambda m=model, p=rays, w=wrench: m.observe(p, w), args.seconds) / n)
            table.add_row(shape_name, label, *(f"{t:.2f}" for t in times))
    for label, (outputs, options) in MODES.items():
        times = []
        for n in args.batches:
            model = TouchModel(with_options(config, options), n, device, outputs)
            pads, seeds = torch.arange(n, device=device), np.arange(n)
            times.append(milliseconds(lambda m=model, p=pads, s=seeds: m.reset(p, s), args.seconds) / n)
        table.add_row("reset", label, *(f"{t:.3f}" for t in times))
    env: Any = gym.make("ManiFeel-PegInsertion-v1", obs_mode="none", render_backend="none", sensor=name).unwrapped
    env.reset(seed=0)
    for label, (outputs, options) in MODES.items():
        sensor = TactileSensor(with_options(config, options), env.scene, env.agent.robot, outputs)
        table.add_row("a held peg, in the environment", label, f"{milliseconds(sensor.capture, args.seconds):.2f}")
    env.close()
    return table


def main(args: Args) -> None:
    console, device = Console(), torch.device(args.device)
    name = torch.cuda.get_device_name() if device.type == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    console.print(name)
    for sensor in args.sensors:
        console.print(sensor_table(sensor, args, device))

    config = gelsight_r15("touch", "gel_right")
    model = TouchModel(config, 1, torch.device("cpu"))
    ball = shapes()["ball, 20,480 triangles"]
    rays, wrench = press(config, ball, 1, torch.device("cpu")), torch.tensor([PUSH], dtype=torch.float64)
    model.observe(rays, wrench)
    optics, lookup = model.optics, any_table()
    assert optics is not None
    depth = rays.heights(model.pixels).clamp(min=0).unflatten(1, config.image_shape)
    surface = optics.surface(depth)
    background, plain = optics.levels.round().to(torch.uint8).numpy(), surface[0].double().numpy()
    with use_torch_threads_for_warp():  # as the sensor runs it
        ours = milliseconds(lambda: optics.shade(surface), args.seconds)
        skirted = milliseconds(lambda: optics.shade(optics.surface(depth)), args.seconds)
    theirs = milliseconds(lambda: table_lookup(plain, lookup, background, config.pixel_size), args.seconds)
    per_pixel = 1e6 / plain.size
    console.print(
        f"on this CPU, ns per pixel: table look-up in numpy {theirs * per_pixel:.0f}, our shader {ours * per_pixel:.0f} "
        f"({theirs / ours:.1f} times faster), with the gel's skirt {skirted * per_pixel:.0f} ({theirs / skirted:.1f} times)"
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
