"""Configuration of a gel-based tactile sensor: pad, gel, image, taxels, optics and what is randomised."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import sapien
from mani_skill.sensors.base_sensor import BaseSensorConfig

from manifeel_ms3.arguments import by_name, is_number, one_of
from manifeel_ms3.errors import InvalidArgumentError, UnknownNameError
from manifeel_ms3.paths import data_dir

DEPTH_BACKENDS = ("auto", "raycast", "sapien")
UNITS = ("newton", "tacsl")
ROUNDING = 1e-9  # m: an extent may exceed the gel's by this much, which is rounding and not geometry


@dataclass(frozen=True)
class Bounds:
    """Range of the number, or of each number, that a field holds; `low` belongs to it unless `high` is infinite."""

    low: float = 0.0
    high: float = math.inf

    def __contains__(self, number: float) -> bool:
        return is_number(number) and (self.low < number if math.isinf(self.high) else self.low <= number <= self.high)

    def __str__(self) -> str:
        return "positive" if math.isinf(self.high) else f"in [{self.low:g}, {self.high:g}]"


def _positive(default: Any) -> Any:
    """Dataclass field for positive numbers."""
    return field(default=default, metadata={"bounds": Bounds()})


def _within(default: float, low: float, high: float) -> Any:
    """Dataclass field for a number from `low` to `high`."""
    return field(default=default, metadata={"bounds": Bounds(low, high)})


@dataclass
class GelConfig:
    """The elastomer as an elastic layer bonded to a rigid back."""

    size: tuple[float, float] = _positive((0.024, 0.032))
    """Extent across and along the finger, m (elastomer of TacSL's GelSight R1.5 asset: 23.98 mm x 32 mm)."""
    thickness: float = _positive(4.25e-3)
    """Thickness of the elastic layer, m (GelSight gel pads: 4.0 mm to 4.5 mm; that of the R1.5 was not published)."""
    youngs_modulus: float = _positive(0.3e6)
    """Young's modulus E, Pa (silicones of GelSight gels: 0.1 MPa to 0.5 MPa)."""
    poisson_ratio: float = _within(0.3, 0.0, 0.499)
    """Effective Poisson ratio nu; a bonded layer of 0.5 would be rigid, while real pads bulge at their free rim."""
    friction: float = _positive(1.0)
    """Coulomb coefficient mu of the bristle model; at least that of the simulated contact, so that its force is not cut."""
    max_penetration: float = _positive(2.0e-3)
    """Deepest penetration that is reported, m (chosen: half of the gel's thickness); forces are not cut."""

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
    """From the height of the gel's surface to an RGB image."""

    calibration: Path = field(default_factory=lambda: data_dir() / "gelsight_r15_shader.npz")
    """Path of the compact shader's coefficients (written by `optics.fit_shader`), or of a `polycalib.npz` in Taxim's format."""
    smoothing: float = _within(1.0, 0.0, 20.0)
    """Standard deviation of the blur of the gel's surface, pixels (chosen: the reflective coat does not follow an edge)."""
    shadow: float = _within(0.0, 0.0, 1.0)
    """Share of a channel's light that a bump keeps from what lies behind it; the fitted colours contain no shadow."""
    noise: float = _within(0.0, 0.0, 255.0)
    """Standard deviation of the seeded read noise, grey levels of 255 (typical of a camera: 2 to 4)."""
    markers: bool = False
    """Whether dots are printed on the skin; they move with its shear and spread where it is pressed."""
    marker_pitch: float = _positive(2.06e-3)
    """Distance of neighbouring dots, m (GelSight's marker gels: 7 x 9 dots)."""
    marker_radius: float = _positive(3.5e-4)
    """Radius of a dot, m (chosen by eye after images of GelSight's marker gels)."""


@dataclass
class TouchRandomization:
    """Differences between pads and episodes, as half widths of uniform distributions around the config's values.

    All are 0 by default, which switches them off. The draws of an episode depend on its seed alone.
    """

    gain: float = _within(0.0, 0.0, 1.0)
    """Relative half width of the colour change's gain; each channel has its own gain."""
    light_phase: float = _within(0.0, 0.0, 3.15)
    """Half width of the turn of all lights about the pad's normal, rad (0.17 rad is 10 degrees)."""
    stiffness: float = _within(0.0, 0.0, 0.99)
    """Relative half width of `gel.youngs_modulus`."""
    friction: float = _within(0.0, 0.0, 0.99)
    """Relative half width of `gel.friction`."""

    def draw_gels(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Factors of the stiffness and of the friction, (P,) each, for the seeds (P,) of P episodes."""
        stiffness, friction = _uniform_draws(seeds, stream=0, count=2).T
        return 1 + self.stiffness * stiffness, 1 + self.friction * friction

    def draw_lights(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gains (P, 3) of the channels and turns (P,) of the lights, rad, for the seeds (P,) of P episodes."""
        draws = _uniform_draws(seeds, stream=1, count=4)
        return 1 + self.gain * draws[:, :3], self.light_phase * draws[:, 3]


def _uniform_draws(seeds: np.ndarray, stream: int, count: int) -> np.ndarray:
    """Numbers (P, count) in [-1, 1); each row is a function of its seed and of the stream."""
    draws = [np.random.default_rng([seed, stream]).uniform(-1, 1, count) for seed in seeds.tolist()]
    return np.reshape(draws, (len(seeds), count))


@dataclass
class TactileSensorConfig(BaseSensorConfig):
    """One pad of a robot.

    Pad frame: origin at the centre of the untouched face, x along image rows (across the finger), y along image columns
    (towards the tip), z out of the gel.

    Raises:
        InvalidArgumentError: A field has a value that is not allowed; the message names the field.
    """

    uid: str = "tactile"
    """Name of the sensor in observations and messages."""
    link: str = "gel_right"
    """Name of the link that carries the gel and nothing else that is touched; the force of its joint is measured."""
    pad_pose: sapien.Pose = field(default_factory=sapien.Pose)
    """Pose of the pad frame in the link's frame, m."""
    gel: GelConfig = field(default_factory=GelConfig)
    """Mechanical properties of the elastomer."""
    image_shape: tuple[int, int] = _positive((240, 320))
    """Rows and columns of the TacRGB image, pixels (the paper's 320 x 240 image, laid on its side)."""
    pixel_size: float = _positive(8.77e-5)
    """Size of a pixel on the gel's face, m (Taxim's calibration of the R1.5: 0.0877 mm)."""
    taxel_shape: tuple[int, int] = _positive((10, 14))
    """Rows and columns of the force field (the paper's)."""
    taxel_pitch: float = _positive(1.634e-3)
    """Distance of neighbouring taxels, m (TacSL's grid on the R1.5)."""
    optics: OpticsConfig = field(default_factory=OpticsConfig)
    """From the gel's surface to the image."""
    backend: Literal["auto", "raycast", "sapien"] = "auto"
    """Source of depth: rays against the meshes, which need no renderer ("raycast", "auto"), or a SAPIEN camera in the pad."""
    units: Literal["newton", "tacsl"] = "newton"
    """Quantity of the force field: N per taxel, or the paper's own, penetration and 0.1 |v_t| (see `taxels.tacsl_field`)."""
    randomization: TouchRandomization = field(default_factory=TouchRandomization)
    """Differences between episodes."""

    def __post_init__(self):
        _check_bounds(self, self.uid)
        one_of("units", self.units, UNITS)
        one_of("backend", self.backend, DEPTH_BACKENDS)
        self._check_extent("taxel_shape x taxel_pitch", self.taxel_shape, self.taxel_pitch)
        self._check_extent("image_shape x pixel_size", self.image_shape, self.pixel_size)

    def _check_extent(self, name: str, shape: tuple[int, int], pitch: float) -> None:
        extent = tuple(n * pitch for n in shape)
        if any(e > g + ROUNDING for e, g in zip(extent, self.gel.size, strict=True)):
            raise InvalidArgumentError(
                f"{name} of tactile sensor {self.uid!r} covers {_millimetres(extent)}, more than the gel's "
                f"{_millimetres(self.gel.size)}; use fewer or smaller cells, or a larger gel.size"
            )


def _check_bounds(config: Any, uid: str, prefix: str = "") -> None:
    for entry in dataclasses.fields(config):
        name, value = prefix + entry.name, getattr(config, entry.name)
        if dataclasses.is_dataclass(value):
            _check_bounds(value, uid, f"{name}.")
        bounds = entry.metadata.get("bounds")
        if bounds and any(number not in bounds for number in (value if isinstance(value, Sequence) else (value,))):
            raise InvalidArgumentError(f"{name}={value!r} of tactile sensor {uid!r} must be {bounds}")


def with_options(config: TactileSensorConfig, options: Mapping[str, Any]) -> TactileSensorConfig:
    """The config with some fields changed, by dotted name: `{"units": "tacsl", "optics.noise": 2.0}`.

    Raises:
        UnknownNameError: A name is not that of a field.
        InvalidArgumentError: A value is not allowed.
    """
    for name, value in by_name("tactile", options, '{"units": "tacsl", "optics.noise": 2.0}').items():
        config = _with_option(config, name.split("."), value, name)
    return config


def _with_option(config: Any, path: list[str], value: Any, name: str) -> Any:
    known = [entry.name for entry in dataclasses.fields(config)] if dataclasses.is_dataclass(config) else []
    if path[0] not in known:
        raise UnknownNameError(f"tactile option {name!r}: {path[0]!r} is not a field; choose from {known}")
    present = getattr(config, path[0])
    if len(path) > 1:
        value = _with_option(present, path[1:], value, name)
    elif not _is_like(value, present):
        raise InvalidArgumentError(f"tactile option {name!r}: expected a value like {present!r}, not {value!r}")
    changed: dict[str, Any] = {path[0]: tuple(value) if isinstance(present, tuple) else value}
    return dataclasses.replace(cast(Any, config), **changed)


def _is_like(value: Any, present: Any) -> bool:
    """Whether `value` has the type, and for a tuple the length, that a field with the value `present` needs."""
    if isinstance(present, tuple):
        return isinstance(value, list | tuple) and len(value) == len(present) and all(map(_is_like, value, present))
    if isinstance(present, float):
        return is_number(value)
    if isinstance(present, str | Path):
        return isinstance(value, str | Path)
    return type(value) is type(present)


def _millimetres(extent: tuple[float, ...]) -> str:
    return " x ".join(f"{1e3 * e:.2f}" for e in extent) + " mm"


def gelsight_r15(uid: str, link: str, **overrides: Any) -> TactileSensorConfig:
    """GelSight R1.5, the paper's sensor: 240 x 320 image at 0.0877 mm, 10 x 14 taxels at 1.634 mm."""
    return TactileSensorConfig(uid=uid, link=link, **overrides)


def gelsight_mini(uid: str, link: str, **overrides: Any) -> TactileSensorConfig:
    """GelSight Mini (data sheet): 15.6 x 20.8 mm window at 0.065 mm per pixel, on its 20.75 x 25.25 mm gel."""
    defaults: dict[str, Any] = dict(gel=GelConfig(size=(0.02075, 0.02525)), pixel_size=6.5e-5, taxel_pitch=1.4e-3)
    return TactileSensorConfig(uid=uid, link=link, **(defaults | overrides))
