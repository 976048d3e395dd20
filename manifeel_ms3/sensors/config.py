"""Configuration of a gel-based tactile sensor: pad, gel, image, taxels, optics and randomization."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast, get_args

import numpy as np
import sapien
from mani_skill.sensors.base_sensor import BaseSensorConfig

from manifeel_ms3.arguments import is_number, one_of
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.paths import data_dir

from .config_fields import check_bounds, counts, positive, within
from .draws import uniform_draws
from .imperfection_config import FULL_SCALE_FORCE, ImperfectionConfig

DepthBackend = Literal["raycast", "sapien"]
Units = Literal["newton", "tacsl"]
ROUNDING = 1e-9  # m: an extent may exceed the gel's by this much, which is a rounding error


@dataclass
class GelConfig:
    """The elastomer, modelled as an elastic layer that is bonded to a rigid back."""

    size: tuple[float, float] = positive((0.024, 0.032))
    """Extent across and along the finger, m (elastomer of TacSL's GelSight R1.5 asset: 23.98 mm x 32 mm)."""
    thickness: float = positive(4.25e-3)
    """Thickness of the elastic layer, m (GelSight gel pads: 4.0 mm to 4.5 mm; that of the R1.5 was not published)."""
    youngs_modulus: float = positive(0.3e6)
    """Young's modulus E, Pa (silicones of GelSight gels: 0.1 MPa to 0.5 MPa)."""
    poisson_ratio: float = within(0.3, 0.0, 0.499)
    """Effective Poisson ratio nu; a bonded layer of 0.5 would be rigid, while real pads bulge at their free rim."""
    friction: float = positive(1.0)
    """Coulomb coefficient mu of the bristle model; at least that of the simulated contact, so that its force is not cut."""
    max_penetration: float = positive(2.0e-3)
    """Deepest penetration that is reported, m (chosen: half of the gel's thickness); forces are not cut."""
    curvature: tuple[float, float] = within((0.0, 0.0), 0.0, 1000.0)
    """Curvature of the untouched face across and along the finger, 1/m: 0 is flat, 20 a dome with a radius of 50 mm."""

    def __post_init__(self):
        if isinstance(self.curvature, list):  # would not do as a key of the cached images
            self.curvature = cast("tuple[float, float]", tuple(self.curvature))

    @property
    def normal_stiffness(self) -> float:
        """Pressure per penetration of the thin bonded layer (Winkler), N/m^3: E (1-nu) / ((1+nu) (1-2nu) h)."""
        e, nu = self.youngs_modulus, self.poisson_ratio
        return e * (1 - nu) / ((1 + nu) * (1 - 2 * nu) * self.thickness)

    @property
    def shear_stiffness(self) -> float:
        """Traction per shear displacement of the layer, N/m^3: G / h with G = E / (2 (1+nu))."""
        return self.youngs_modulus / (2 * (1 + self.poisson_ratio)) / self.thickness

    @property
    def is_flat(self) -> bool:
        """Whether the untouched face is a plane."""
        return self.curvature == (0.0, 0.0)

    def sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Depth, m, of the untouched face under the plane through its highest point, at places x, y, m.

        A sphere's cap where both curvatures are equal; else the biconic surface of optics, without conic constants.
        """
        across, along = self.curvature
        root = np.sqrt(np.maximum(1.0 - (across * x) ** 2 - (along * y) ** 2, 0.0))
        return (across * x**2 + along * y**2) / (1.0 + root)

    @property
    def max_sag(self) -> float:
        """Depth, m, of the face's corners under its highest point."""
        return float(self.sag(np.array(self.size[0] / 2), np.array(self.size[1] / 2)))


@dataclass
class HousingConfig:
    """The box-shaped part of the finger that carries the gel. The tool centre point does not depend on its sizes."""

    width: float = positive(0.030)
    """Extent across the finger, m (GelSight R1.5 finger)."""
    depth: float = positive(0.023)
    """Extent from the gel's back to the finger's back, m (GelSight R1.5 finger: 26 mm with its gel)."""
    beyond_gel: float = within(0.002, 0.0, 0.02)
    """Distance from the gel's end to the fingertip, m."""
    protrusion: float = positive(0.003)
    """Height of the gel's highest point above the housing, m; more than the gel's sag."""


@dataclass(frozen=True)
class Light:
    """A small lamp, or a point of a bar of lamps, that lights the gel from behind.

    Raises:
        InvalidArgumentError: The lamp is not behind the face, or its colour is not three numbers, none of them negative.
    """

    position: tuple[float, float, float]
    """Position in the pad frame, m; behind the face, so that its z is negative."""
    colour: tuple[float, float, float]
    """Brightness in red, green and blue, in any unit that is the same for all lamps."""

    def __post_init__(self):
        for name in ("position", "colour"):
            object.__setattr__(self, name, tuple(getattr(self, name)))  # a list would not do as a key of the cached colours
        if len(self.position) != 3 or not all(map(is_number, self.position)) or self.position[2] >= 0:
            raise InvalidArgumentError(
                f"position={self.position} of a lamp must be three coordinates in the pad frame, in m, the last one negative: "
                "lamps are behind the face, whose z is 0"
            )
        if len(self.colour) != 3 or not all(is_number(level) and level >= 0 for level in self.colour):
            raise InvalidArgumentError(
                f"colour={self.colour} of a lamp must be three numbers, none of them negative: its red, green and blue"
            )


@dataclass(frozen=True)
class LightsConfig:
    """Lamps from which the colours are computed (see `optics.lights`).

    Raises:
        InvalidArgumentError: There is no lamp.
    """

    lamps: tuple[Light, ...]
    """All lamps."""
    level: float = within(110.0, 1.0, 255.0)
    """Mean level of each lit channel of the untouched gel, grey levels of 255: what a camera's exposure control would set."""

    def __post_init__(self):
        object.__setattr__(self, "lamps", tuple(self.lamps))
        if not self.lamps:
            raise InvalidArgumentError("lamps=() leaves the gel dark; give at least one Light, or a calibration instead")


@dataclass
class OpticsConfig:
    """Optics of the sensor, which turn the height of the gel's surface into an RGB image."""

    calibration: Path = field(default_factory=lambda: data_dir() / "gelsight_r15_shader.npz")
    """Path of the compact shader's coefficients (written by `optics.fit_shader`), or of a `polycalib.npz` in Taxim's format."""
    lights: LightsConfig | None = None
    """Lamps of a sensor that has no calibration; `calibration` is then not read."""
    smoothing: float = within(1.0, 0.0, 20.0)
    """Standard deviation of the blur of the gel's surface, pixels (chosen: the reflective coat does not follow an edge)."""
    shadow: float = within(0.0, 0.0, 1.0)
    """Share of a channel's light that a bump keeps from what lies behind it; the fitted colours contain no shadow."""
    noise: float = within(0.0, 0.0, 255.0)
    """Standard deviation of the seeded read noise, grey levels of 255 (typical of a camera: 2 to 4)."""
    markers: bool = False
    """Whether dots are printed on the skin; they move with its shear and spread where it is pressed."""
    marker_pitch: float = positive(2.06e-3)
    """Distance of neighbouring dots, m (GelSight's marker gels: 7 x 9 dots)."""
    marker_radius: float = positive(3.5e-4)
    """Radius of a dot, m (chosen by eye after images of GelSight's marker gels)."""


@dataclass
class TouchRandomization:
    """Differences between pads and episodes, as half widths of uniform distributions around the config's values.

    All are 0 by default, which switches them off. The draws depend on the seed of the reset, the name of the pad, and how many
    earlier episodes had this seed (`draws.pad_seeds`).
    """

    gain: float = within(0.0, 0.0, 1.0)
    """Relative half width of the colour change's gain; each channel has its own gain."""
    light_phase: float = within(0.0, 0.0, 3.15)
    """Half width of the turn of all lights about the pad's normal, rad (0.17 rad is 10 degrees)."""
    stiffness: float = within(0.0, 0.0, 0.99)
    """Relative half width of `gel.youngs_modulus`."""
    friction: float = within(0.0, 0.0, 0.99)
    """Relative half width of `gel.friction`."""

    def draw_gels(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Factors of the stiffness and of the friction, (P,) each, for the seeds (P,) of P episodes."""
        stiffness, friction = uniform_draws(seeds, stream=0, count=2).T
        return 1 + self.stiffness * stiffness, 1 + self.friction * friction

    def draw_lights(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gains (P, 3) of the channels and turns (P,) of the lights, rad, for the seeds (P,) of P episodes."""
        draws = uniform_draws(seeds, stream=1, count=4)
        return 1 + self.gain * draws[:, :3], self.light_phase * draws[:, 3]


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
    image_shape: tuple[int, int] = counts((240, 320))
    """Rows and columns of the TacRGB image, pixels (the paper's 320 x 240 image, laid on its side)."""
    pixel_size: float = positive(8.77e-5)
    """Size of a pixel on the gel's face, m (Taxim's calibration of the R1.5: 0.0877 mm)."""
    taxel_shape: tuple[int, int] = counts((10, 14))
    """Rows and columns of the force field (the paper's)."""
    taxel_pitch: float = positive(1.634e-3)
    """Distance of neighbouring taxels, m (TacSL's grid on the R1.5)."""
    optics: OpticsConfig = field(default_factory=OpticsConfig)
    """Optics, which make the image from the gel's surface."""
    housing: HousingConfig = field(default_factory=HousingConfig)
    """Finger that carries the gel on this package's robot."""
    backend: DepthBackend = "raycast"
    """Source of depth: rays against the meshes, which need no renderer, or a SAPIEN camera in the pad ("sapien")."""
    units: Units = "newton"
    """Quantity of the force field: N per taxel, or the paper's own, penetration and 0.1 |v_t| (see `taxels.tacsl_field`)."""
    randomization: TouchRandomization = field(default_factory=TouchRandomization)
    """Differences between episodes."""
    imperfections: ImperfectionConfig = field(default_factory=ImperfectionConfig)
    """What a real sensor adds to the true signal; nothing by default."""

    def __post_init__(self):
        check_bounds(self, self.uid)
        one_of("units", self.units, get_args(Units))
        one_of("backend", self.backend, get_args(DepthBackend))
        self._check_extent("taxel_shape x taxel_pitch", self.taxel_shape, self.taxel_pitch)
        self._check_extent("image_shape x pixel_size", self.image_shape, self.pixel_size)
        self._check_dome()

    @property
    def full_scale(self) -> float:
        """Full scale of a taxel's reading in `units`, N or m, to which imperfections and pictures refer."""
        return FULL_SCALE_FORCE if self.units == "newton" else self.gel.max_penetration

    def _check_dome(self) -> None:
        gel, housing = self.gel, self.housing
        steepest = math.hypot(*(c * extent / 2 for c, extent in zip(gel.curvature, gel.size, strict=True)))
        if steepest >= 1.0:
            raise InvalidArgumentError(
                f"gel.curvature={gel.curvature} of tactile sensor {self.uid!r} folds: a dome of {_millimetres(gel.size)} would "
                f"stand upright before its corners; use less than {min(gel.curvature) / steepest:.3g} to "
                f"{max(gel.curvature) / steepest:.3g} per metre, or a smaller gel.size"
            )
        if gel.max_sag >= housing.protrusion:
            raise InvalidArgumentError(
                f"gel.curvature={gel.curvature} of tactile sensor {self.uid!r}: the corners of its gel lie "
                f"{1e3 * gel.max_sag:.2f} mm under its highest point, inside the housing; raise housing.protrusion="
                f"{housing.protrusion} above that"
            )

    def _check_extent(self, name: str, shape: tuple[int, int], pitch: float) -> None:
        extent = tuple(n * pitch for n in shape)
        if any(e > g + ROUNDING for e, g in zip(extent, self.gel.size, strict=True)):
            raise InvalidArgumentError(
                f"{name} of tactile sensor {self.uid!r} covers {_millimetres(extent)}, more than the gel's "
                f"{_millimetres(self.gel.size)}; use fewer or smaller cells, or a larger gel.size"
            )


def _millimetres(extent: tuple[float, ...]) -> str:
    return " x ".join(f"{1e3 * e:.2f}" for e in extent) + " mm"
