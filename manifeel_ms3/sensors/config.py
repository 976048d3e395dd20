"""Configuration of a gel-based tactile sensor: the pad, the gel, the image, the taxels, the optics."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import sapien
from mani_skill.sensors.base_sensor import BaseSensorConfig

from manifeel_ms3.arguments import by_name, is_number, one_of
from manifeel_ms3.paths import data_dir

DEPTH_BACKENDS = ("auto", "raycast", "sapien")
UNITS = ("newton", "tacsl")


@dataclass
class GelConfig:
    """The elastomer as an elastic layer bonded to a rigid back."""

    size: tuple[float, float] = (0.024, 0.032)
    """Extent across and along the finger, m (GelSight R1.5 elastomer)."""
    thickness: float = 4.25e-3
    """Thickness of the elastic layer, m (GelSight gel pads: 4.0 to 4.5 mm)."""
    youngs_modulus: float = 0.3e6
    """E, Pa (silicone of GelSight gels: 0.1 to 0.5 MPa)."""
    poisson_ratio: float = 0.3
    """nu. An effective value: at 0.5 a bonded layer would be rigid, while real pads bulge at their free rim."""
    friction: float = 1.0
    """Coulomb coefficient mu of the bristle model; at least that of the simulated contact."""
    max_penetration: float = 2.0e-3
    """Deepest penetration reported, m."""

    @property
    def normal_stiffness(self) -> float:
        """Pressure per penetration of the thin bonded layer (Winkler), N/m^3: E (1-nu) / ((1+nu) (1-2nu) h)."""
        e, nu = self.youngs_modulus, self.poisson_ratio
        return e * (1 - nu) / ((1 + nu) * (1 - 2 * nu) * self.thickness)

    @property
    def shear_stiffness(self) -> float:
        """Traction per shear displacement of the layer, N/m^3: G / h with G = E / (2 (1+nu))."""
        return self.youngs_modulus / (2 * (1 + self.poisson_ratio)) / self.thickness


@dataclass
class OpticsConfig:
    """Height map to RGB."""

    calibration: Path = field(default_factory=lambda: data_dir() / "gelsight_r15_shader.npz")
    """Coefficients of the compact shader (`manifeel_ms3.sensors.optics.fit_shader`), or a table in Taxim's format, `polycalib.npz`."""
    smoothing: float = 1.0
    """Blur of the gel's surface, pixels (the reflective coat does not follow an edge)."""
    shadow: float = 0.0
    """Share of a channel's light that a bump takes from what lies behind it, 0 to 1; the fitted colours hold none."""
    noise: float = 0.0
    """Standard deviation of seeded read noise, grey levels of 255 (a camera's: 2 to 4)."""
    markers: bool = False
    """Whether dots are printed on the skin, which move with its shear and spread where it is pressed."""
    marker_pitch: float = 2.06e-3
    """Distance of neighbouring dots, m (GelSight's marker gels: 7 x 9 dots)."""
    marker_radius: float = 3.5e-4
    """Radius of a dot, m."""


@dataclass
class TouchRandomization:
    """What differs from pad to pad and episode to episode: half widths of uniform distributions around the config's values."""

    gain: float = 0.0
    """Of the colours' change, relative, each channel by itself."""
    light_phase: float = 0.0
    """Of the lights' direction, rad (0.17: 10 degrees)."""
    stiffness: float = 0.0
    """Of `gel.youngs_modulus`, relative."""
    friction: float = 0.0
    """Of `gel.friction`, relative."""


@dataclass
class TactileSensorConfig(BaseSensorConfig):
    """One pad. Pad frame: origin at the centre of the untouched face, x along image rows (across the finger), y along image
    columns (towards the tip), z out of the gel.

    Raises:
        ValueError: a value that cannot be; the message names the field.
    """

    uid: str = "tactile"
    link: str = "gel_right"
    """Link of the robot that carries the gel and nothing else that is touched: the force of its joint is measured."""
    pad_pose: sapien.Pose = field(default_factory=sapien.Pose)
    """The pad frame in the link's frame."""
    gel: GelConfig = field(default_factory=GelConfig)
    image_shape: tuple[int, int] = (240, 320)
    """Rows and columns of the TacRGB image."""
    pixel_size: float = 8.77e-5
    """m per pixel (R1.5 calibration: 0.0877 mm)."""
    taxel_shape: tuple[int, int] = (10, 14)
    """Rows and columns of the force field."""
    taxel_pitch: float = 1.634e-3
    """Distance of neighbouring taxels, m (TacSL's grid on the R1.5)."""
    optics: OpticsConfig = field(default_factory=OpticsConfig)
    backend: Literal["auto", "raycast", "sapien"] = "auto"
    """Where depth comes from: rays against the meshes (no renderer needed) or a SAPIEN camera in the pad."""
    units: Literal["newton", "tacsl"] = "newton"
    """Of the force field. "tacsl": the paper's own quantities, penetration and 0.1 |v_t| (`taxels.tacsl_field`)."""
    randomization: TouchRandomization = field(default_factory=TouchRandomization)

    def __post_init__(self):
        _require_positive(self)
        _require_in_range(self)
        one_of("units", self.units, UNITS)
        one_of("backend", self.backend, DEPTH_BACKENDS)
        for name, shape, pitch in (
            ("taxel_shape x taxel_pitch", self.taxel_shape, self.taxel_pitch),
            ("image_shape x pixel_size", self.image_shape, self.pixel_size),
        ):
            extent = tuple(n * pitch for n in shape)
            if any(e > g + 1e-9 for e, g in zip(extent, self.gel.size, strict=True)):
                raise ValueError(
                    f"{name} of tactile sensor {self.uid!r} covers {_mm(extent)}, more than the gel's {_mm(self.gel.size)}; "
                    "use fewer or smaller cells, or a larger gel.size"
                )


def _require_positive(config: TactileSensorConfig) -> None:
    gel = config.gel
    values = {
        "gel.size": gel.size,
        "gel.thickness": (gel.thickness,),
        "gel.youngs_modulus": (gel.youngs_modulus,),
        "gel.friction": (gel.friction,),
        "gel.max_penetration": (gel.max_penetration,),
        "image_shape": config.image_shape,
        "pixel_size": (config.pixel_size,),
        "taxel_shape": config.taxel_shape,
        "taxel_pitch": (config.taxel_pitch,),
        "optics.marker_pitch": (config.optics.marker_pitch,),
        "optics.marker_radius": (config.optics.marker_radius,),
    }
    for name, value in values.items():
        if any(not v > 0 for v in value):
            raise ValueError(f"{name}={value} of tactile sensor {config.uid!r} must be positive")


def _require_in_range(config: TactileSensorConfig) -> None:
    optics, randomization = config.optics, config.randomization
    limits = {
        "gel.poisson_ratio": (config.gel.poisson_ratio, 0.0, 0.499),
        "optics.smoothing": (optics.smoothing, 0.0, 20.0),
        "optics.shadow": (optics.shadow, 0.0, 1.0),
        "optics.noise": (optics.noise, 0.0, 255.0),
        "randomization.gain": (randomization.gain, 0.0, 1.0),
        "randomization.light_phase": (randomization.light_phase, 0.0, 3.15),
        "randomization.stiffness": (randomization.stiffness, 0.0, 0.99),
        "randomization.friction": (randomization.friction, 0.0, 0.99),
    }
    for name, (value, low, high) in limits.items():
        if not low <= value <= high:
            raise ValueError(f"{name}={value} of tactile sensor {config.uid!r} must lie in [{low}, {high}]")


def with_options(config: TactileSensorConfig, options: Mapping[str, Any]) -> TactileSensorConfig:
    """The config with some fields changed, by dotted name: `{"units": "tacsl", "optics.noise": 2.0}`.

    Raises:
        ValueError: a name that is no field, or a value that cannot be.
    """
    for name, value in by_name("tactile", options, '{"units": "tacsl", "optics.noise": 2.0}').items():
        config = _with(config, name.split("."), value, name)
    return config


def _with(config: Any, path: list[str], value: Any, name: str) -> Any:
    known = [f.name for f in dataclasses.fields(config)] if dataclasses.is_dataclass(config) else []
    if path[0] not in known:
        raise ValueError(f"tactile option {name!r}: {path[0]!r} is not one of {known}")
    present = getattr(config, path[0])
    if len(path) > 1:
        value = _with(present, path[1:], value, name)
    elif not _alike(value, present):
        raise ValueError(f"tactile option {name!r}: {value!r} is not of the kind of {present!r}")
    return dataclasses.replace(config, **{path[0]: value})


def _alike(value: Any, present: Any) -> bool:
    """Whether `value` can stand where `present` does."""
    if isinstance(present, tuple):
        same_length = isinstance(value, list | tuple) and len(value) == len(present)
        return same_length and all(_alike(one, other) for one, other in zip(value, present, strict=True))
    if is_number(present):
        return is_number(value) and (isinstance(value, int) or isinstance(present, float))
    return isinstance(value, str | Path if isinstance(present, Path) else type(present))


def _mm(extent: tuple[float, ...]) -> str:
    return " x ".join(f"{1e3 * e:.2f}" for e in extent) + " mm"


def gelsight_r15(uid: str, link: str, **overrides) -> TactileSensorConfig:
    """GelSight R1.5, the paper's sensor: 240 x 320 image at 0.0877 mm, 10 x 14 taxels at 1.634 mm."""
    return TactileSensorConfig(uid=uid, link=link, **overrides)


def gelsight_mini(uid: str, link: str, **overrides) -> TactileSensorConfig:
    """GelSight Mini: 15.6 x 20.8 mm window at 0.065 mm per pixel, on its 20.75 x 25.25 mm gel."""
    defaults = dict(gel=GelConfig(size=(0.02075, 0.02525)), pixel_size=6.5e-5, taxel_pitch=1.4e-3)
    return TactileSensorConfig(uid=uid, link=link, **{**defaults, **overrides})
