"""Draws the figures of docs/sensor.md: run `python -m docs.make_sensor_figures` in the repository's root."""

from pathlib import Path

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
import trimesh

from manifeel_ms3.sensors import GelConfig, gelsight_r15, sensor_config, with_options
from manifeel_ms3.sensors.depth.raycast import MeshRays
from manifeel_ms3.sensors.touch_model import TouchModel
from manifeel_ms3.sensors.visualisation import force_field_images
from tests.sensors import shapes

IMAGES = Path(__file__).parent / "images"
CONFIG = gelsight_r15("touch", "gel_right")
CPU = torch.device("cpu")
MAX_ITERATIONS = 300  # of the conjugate gradients, which end earlier when they have converged
AROUND_X = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
ON_EDGE = trimesh.transformations.rotation_matrix(np.pi / 4, [0, 1, 0])


def indenters() -> dict[str, tuple[trimesh.Trimesh, float]]:
    """Mesh, with its lowest point at height zero, and load, N, by name."""
    return {
        "ball, 8 mm": (_lifted(trimesh.creation.icosphere(subdivisions=6, radius=8e-3)), 3.0),
        "rod, 6 mm": (_lifted(trimesh.creation.cylinder(6e-3, 0.02, sections=720).apply_transform(AROUND_X)), 5.0),
        "bar on its edge": (_lifted(trimesh.creation.box([0.01, 0.016, 0.01]).apply_transform(ON_EDGE)), 3.0),
        "box, 8 x 12 mm": (_lifted(trimesh.creation.box([8e-3, 12e-3, 8e-3])), 5.0),
        "M16 thread, 2 mm": (_lifted(shapes.thread_mesh()), 5.0),
        "dimples, 0.25 mm": (_lifted(shapes.dimple_mesh()), 8.0),
    }


def _lifted(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])


def pressed(mesh: trimesh.Trimesh) -> MeshRays:
    """Rays of one pad under one mesh."""
    return MeshRays([[mesh]], CONFIG.gel.size, CPU)


def touch(mesh: trimesh.Trimesh, load: float, shear: tuple[float, float] = (0.0, 0.0), twist: float = 0.0, **options):
    model = TouchModel(with_options(CONFIG, options), 1, CPU)
    wrench = torch.tensor([[*shear, -load, 0.0, 0.0, twist]], dtype=torch.float64)
    return {name: value[0] for name, value in model.observe(pressed(mesh), wrench).items()}


def gallery() -> None:
    """Draw height, TacRGB and force field under shear for every indenter, and the options of the optics for one."""
    rows = []
    for name, (mesh, load) in indenters().items():
        model = TouchModel(CONFIG, 1, CPU)
        height = pressed(mesh).heights(model.pixels).unflatten(1, CONFIG.image_shape)[0].numpy()
        relief = (255 * np.clip(1 + height / 1.5e-3, 0, 1)).astype(np.uint8)
        plain = touch(mesh, load)
        sheared = touch(mesh, load, shear=(0.0, 0.3 * load), twist=1e-3)
        field = force_field_images(sheared["force_field"][None], CONFIG.full_scale, CONFIG.image_shape)[0].numpy()
        label = np.full((240, 130, 3), 255, np.uint8)
        for k, line in enumerate([*name.split(", "), f"{load:.0f} N"]):
            cv2.putText(label, line, (4, 110 + 22 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
        rows.append(np.hstack([label, np.repeat(relief[..., None], 3, -1), plain["rgb"].numpy(), field]))
    _save("indenters.png", np.vstack(rows))
    ball = indenters()["ball, 8 mm"][0]
    variants = [{}, {"optics.shadow": 0.6}, {"optics.markers": True}, {"optics.noise": 4.0}]
    _save("options.png", np.hstack([touch(ball, 5.0, (1.0, 1.5), **v)["rgb"].numpy() for v in variants]))


SIDE_BY_SIDE = ("ball, 8 mm", "rod, 6 mm", "box, 8 x 12 mm", "M16 thread, 2 mm", "dimples, 0.25 mm")
PANEL = (160, 213)  # rows and columns of a picture, pixels


def side_by_side() -> None:
    """Draw TacRGB and force field of five objects on three sensors, under the loads of the gallery and shear."""
    sensors = {"GelSight R1.5": "gelsight_r15", "GelSight Mini": "gelsight_mini", "DIGIT": "digit"}
    header = [_label("", PANEL[1] // 2, 28)] + [_label(f"{t}: {kind}", PANEL[1], 28) for t in sensors for kind in ("RGB", "FF")]
    rows = [np.hstack(header)]
    for name in SIDE_BY_SIDE:
        mesh, load = indenters()[name]
        row = [_label(f"{name.replace(', ', chr(10))}\n{load:.0f} N", PANEL[1] // 2, PANEL[0])]
        for sensor in sensors.values():
            config = sensor_config(sensor, "touch", "gel")
            rays = MeshRays([[mesh]], config.gel.size, CPU, config.gel.max_sag)
            wrench = torch.tensor([[0.0, 0.3 * load, -load, 0.0, 0.0, 1e-3]], dtype=torch.float64)
            obs = TouchModel(config, 1, CPU).observe(rays, wrench)
            field = force_field_images(obs["force_field"], config.full_scale, config.image_shape)[0].numpy()
            row += [cv2.resize(p, PANEL[::-1], interpolation=cv2.INTER_AREA) for p in (obs["rgb"][0].numpy(), field)]
        rows.append(np.hstack(row))
    _save("sensors.png", np.vstack(rows))


def _label(text: str, width: int, height: int) -> np.ndarray:
    label = np.full((height, width, 3), 255, np.uint8)
    for k, line in enumerate(text.split("\n")):
        cv2.putText(label, line, (4, 18 + 20 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return label


def _save(name: str, picture: np.ndarray) -> None:
    cv2.imwrite(str(IMAGES / name), picture[..., ::-1])


def bonded_layer_force(radius: float, depth: float, gel: GelConfig, cells: int = 128, size: float = 0.03) -> float:
    """Load, N, of a rigid ball pressed `depth` into an elastic layer bonded to a rigid back (frictionless, linear).

    Surface displacement per pressure in wave space, u / p = (1 - nu) / (G k) ((3 - 4 nu) sinh 2kh - 2kh) /
    ((3 - 4 nu) cosh 2kh + 2 (kh)^2 + 5 - 12 nu + 8 nu^2) (Johnson, Contact Mechanics, 1985); contact by conjugate gradients on
    the pressed cells (Polonsky & Keer 1999).
    """
    nu, h = gel.poisson_ratio, gel.thickness
    shear_modulus = gel.youngs_modulus / (2 * (1 + nu))
    wave = 2 * np.pi * np.fft.fftfreq(cells, size / cells)
    k = np.hypot(*np.meshgrid(wave, wave))
    k[0, 0] = 1e-3
    kh = np.minimum(k * h, 300)
    compliance = (1 - nu) / (shear_modulus * k) * ((3 - 4 * nu) * np.sinh(2 * kh) - 2 * kh)
    compliance /= (3 - 4 * nu) * np.cosh(2 * kh) + 2 * kh**2 + 5 - 12 * nu + 8 * nu**2
    x = (np.arange(cells) - cells // 2) * size / cells
    r2 = x[:, None] ** 2 + x[None] ** 2
    wanted = np.where(r2 < radius**2, depth - radius + np.sqrt(np.maximum(radius**2 - r2, 0)), -1.0)

    def sunk(pressure: np.ndarray) -> np.ndarray:
        return np.fft.ifft2(compliance * np.fft.fft2(pressure)).real

    pressure = np.maximum(wanted, 0) * gel.normal_stiffness
    direction, last = np.zeros_like(pressure), 1.0
    for _ in range(MAX_ITERATIONS):
        residual = wanted - sunk(pressure)
        inside = pressure > 0
        squared = (residual[inside] ** 2).sum()
        direction = np.where(inside, residual + squared / last * direction, 0.0)
        step = (residual * direction)[inside].sum() / max((direction * sunk(direction))[inside].sum(), 1e-30)
        pressure, last = np.maximum(pressure + step * direction, 0.0), squared
        added = (pressure == 0) & (wanted - sunk(pressure) > 0)
        if added.any():
            pressure = np.where(added, step * residual, pressure).clip(0)
            last, direction = np.inf, np.zeros_like(direction)
        elif np.sqrt(squared / inside.sum()) < 1e-9:
            break
    return float(pressure.sum() * (size / cells) ** 2)


def layer_laws() -> None:
    """Draw force against depth of a ball for the model's Winkler layer, Hertz's half-space and the bonded layer."""
    gel, depths = CONFIG.gel, np.linspace(1e-4, 1.2e-3, 12)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharex=True)
    for axis, radius in zip(axes, (4e-3, 10e-3), strict=True):
        winkler = np.pi * gel.normal_stiffness * depths**2 * (radius - depths / 3)
        hertz = 4 / 3 * gel.youngs_modulus / (1 - gel.poisson_ratio**2) * np.sqrt(radius) * depths**1.5
        bonded = [bonded_layer_force(radius, depth, gel) for depth in depths]
        axis.plot(1e3 * depths, winkler, "-", label="Winkler layer (this model)")
        axis.plot(1e3 * depths, hertz, "--", label="Hertz, infinitely thick")
        axis.plot(1e3 * depths, bonded, "o", label="bonded layer, 4.25 mm")
        axis.set(title=f"ball of {1e3 * radius:.0f} mm", xlabel="depth, mm", ylabel="force, N")
        for depth in (5e-4, 1e-3):
            at = np.argmin(np.abs(depths - depth))
            print(f"R {radius}, d {depths[at]:.4f}: {winkler[at]:.3f} {hertz[at]:.3f} {bonded[at]:.3f} N")  # noqa: T201
    axes[0].legend()
    figure.tight_layout()
    figure.savefig(IMAGES / "layer_laws.png", dpi=110)


if __name__ == "__main__":
    IMAGES.mkdir(exist_ok=True)
    gallery()
    side_by_side()
    layer_laws()
