"""Configuration of a gel-based tactile sensor: the pad, the gel, the image, the taxels, the optics."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mani_skill.sensors.base_sensor import BaseSensorConfig

from manifeel_ms3.paths import data_dir

DEPTH_BACKENDS = ("auto", "raycast", "sapien")


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
    """Coefficients of the compact shader, written by `manifeel_ms3.sensors.fit_shader`."""
    smoothing: float = 1.0
    """Blur of the gel's surface, pixels (the reflective coat does not follow an edge)."""
    noise: float = 0.0
    """Standard deviation of seeded read noise, grey levels of 255."""


@dataclass
class TactileSensorConfig(BaseSensorConfig):
    """One pad. Pad frame: origin at the centre of the untouched face, x along image rows (across the finger), y along image
    columns (towards the tip), z out of the gel."""

    uid: str = "tactile"
    link: str = "gel_right"
    """Link of the robot that is the pad; its frame is the pad frame, and it hangs on a fixed joint, whose force is measured."""
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

    def __post_init__(self):
        _require_positive(self)
        if self.backend not in DEPTH_BACKENDS:
            raise ValueError(f"backend={self.backend!r} of tactile sensor {self.uid!r} is unknown; use one of {DEPTH_BACKENDS}")
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
    }
    for name, value in values.items():
        if any(not v > 0 for v in value):
            raise ValueError(f"{name}={value} of tactile sensor {config.uid!r} must be positive")
    if not 0 <= gel.poisson_ratio < 0.5:
        raise ValueError(f"gel.poisson_ratio={gel.poisson_ratio} of tactile sensor {config.uid!r} must lie in [0, 0.5)")


def _mm(extent: tuple[float, ...]) -> str:
    return " x ".join(f"{1e3 * e:.2f}" for e in extent) + " mm"


def gelsight_r15(uid: str, link: str, **overrides) -> TactileSensorConfig:
    """GelSight R1.5, the paper's sensor: 240 x 320 image at 0.0877 mm, 10 x 14 taxels at 1.634 mm."""
    return TactileSensorConfig(uid=uid, link=link, **overrides)


def gelsight_mini(uid: str, link: str, **overrides) -> TactileSensorConfig:
    """GelSight Mini: 15.6 x 20.8 mm window at 0.065 mm per pixel, on its 20.75 x 25.25 mm gel."""
    defaults = dict(gel=GelConfig(size=(0.02075, 0.02525)), pixel_size=6.5e-5, taxel_pitch=1.4e-3)
    return TactileSensorConfig(uid=uid, link=link, **{**defaults, **overrides})
