"""The sensors by name: those of this package, and those that other packages add through the entry points `manifeel.sensors`.

An entry point is a function that returns the configuration of one pad. `docs/sensor.md` shows a package with its own sensor.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from manifeel_ms3 import plugins
from manifeel_ms3.arguments import is_number
from manifeel_ms3.errors import InvalidArgumentError, PluginError, UnknownNameError
from manifeel_ms3.paths import data_dir

from .config import (
    GelConfig,
    HousingConfig,
    Light,
    LightsConfig,
    OpticsConfig,
    TactileSensorConfig,
)
from .config_fields import with_options
from .mounting import grids_for

MakeSensor = Callable[[str, str], TactileSensorConfig]
"""Function from the name of a pad in observations, and the name of the link that carries its gel, to its configuration."""
TAXEL_PITCH = 1.6e-3
"""Pitch, m, of sensors without a published force field (chosen: near the R1.5's, so that policies see similar fields)."""
DEFAULT_SENSOR = "gelsight_r15"
"""Name of the paper's sensor."""


def gelsight_r15(uid: str, link: str) -> TactileSensorConfig:
    """GelSight R1.5, the paper's sensor: 240 x 320 image at 0.0877 mm, 10 x 14 taxels at 1.634 mm."""
    return TactileSensorConfig(uid=uid, link=link)


def gelsight_mini(uid: str, link: str) -> TactileSensorConfig:
    """GelSight Mini: a window of 14.2 x 18.9 mm at 0.059 mm per pixel on its gel of 20.75 x 25.25 mm.

    The camera's 3280 x 2464 pixels are cropped and shrunk to 320 x 240 by the maker's software (gsrobotics). The data sheet
    gives a window of 18.6 x 14.3 mm; the images of a Mini that the package taxim ships have 0.0295 mm per pixel at 640 x 480,
    hence 18.9 x 14.2 mm. The colours are fitted to those images.
    """
    gel = GelConfig(size=(0.02075, 0.02525))  # gel pad of the data sheet, 4.25 mm thick
    return TactileSensorConfig(
        uid=uid,
        link=link,
        gel=gel,
        pixel_size=5.9e-5,
        taxel_pitch=TAXEL_PITCH,
        optics=OpticsConfig(calibration=data_dir() / "gelsight_mini_shader.npz"),
        # outer size of the data sheet: 28 mm across, 32 mm along and, with the gel's 3 mm, 24 mm deep
        housing=HousingConfig(width=0.028, depth=0.021, beyond_gel=(0.032 - gel.size[1]) / 2),
    )


def digit(uid: str, link: str) -> TactileSensorConfig:
    """DIGIT: a domed gel of 20 x 30 mm, a 240 x 320 image of its middle 14 x 19 mm, and lamps in red, green and blue.

    Gel, dome and lamps are those of the maker's own simulator (TACTO, `config_digit.yml`, MIT License): corners 5 mm under the
    middle, which is a radius of 35 mm, and lamps at 30, 150 and 270 degrees on a circle of 20 mm, 17 mm behind the face. The
    window's length is the 19 mm of the maker's paper (Lambeta et al. 2020). No calibration of its colours is published under a
    free licence: they are computed from the lamps.
    """
    gel = GelConfig(size=(0.020, 0.030), curvature=(1 / 0.035, 1 / 0.035))
    lamps = zip(np.deg2rad((30.0, 150.0, 270.0)), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), strict=True)
    # TACTO's y is across the finger and its z along it
    around = [Light((0.020 * np.cos(turn), 0.020 * np.sin(turn), -0.017), colour) for turn, colour in lamps]
    return TactileSensorConfig(
        uid=uid,
        link=link,
        gel=gel,
        pixel_size=0.019 / 320,
        taxel_pitch=TAXEL_PITCH,
        optics=OpticsConfig(lights=LightsConfig(tuple(around))),
        # 18 mm deep without its gel (Lambeta et al. 2020); width, tip and protrusion are chosen, the last above the dome's sag
        housing=HousingConfig(width=0.026, depth=0.018, beyond_gel=0.003, protrusion=0.008),
    )


SENSORS: dict[str, MakeSensor] = {"gelsight_r15": gelsight_r15, "gelsight_mini": gelsight_mini, "digit": digit}
"""The package's own sensors."""


def sensor_names() -> list[str]:
    """Names of all sensors: the package's own, followed by those of other packages."""
    return [*SENSORS, *(name for name in plugins.registered(plugins.SENSORS) if name not in SENSORS)]


def sensor_config(name: str, uid: str, link: str, **changes: Any) -> TactileSensorConfig:
    """The configuration of one pad of a sensor.

    Args:
        name: Name of the sensor.
        uid: Name of the pad in observations.
        link: Name of the link that carries its gel.
        changes: Fields to replace, such as `pad_pose`.

    Raises:
        UnknownNameError: No sensor has this name; the message lists the known ones.
        PluginError: A plug-in has the name of one of the package's own sensors, or does not return a configuration.
        InvalidArgumentError: A field has a value that is not allowed.
    """
    if name not in sensor_names():
        raise UnknownNameError(f"sensor={name!r} is not registered; choose from {sensor_names()}")
    if name in SENSORS and name in plugins.registered(plugins.SENSORS):
        raise PluginError(f"the plug-in sensor {name!r} has the name of one of manifeel's own; rename it")
    make: MakeSensor = SENSORS[name] if name in SENSORS else plugins.load(plugins.SENSORS, name)
    config = make(uid, link)
    if not isinstance(config, TactileSensorConfig):
        raise PluginError(f"the plug-in sensor {name!r} returns {config!r}; it must return a TactileSensorConfig")
    return dataclasses.replace(config, **changes)


def task_sensor(
    name: str, uid: str, link: str, options: Mapping[str, Any] | None, imperfections: Mapping[str, Any] | None
) -> TactileSensorConfig:
    """The configuration of one pad, from the arguments of a task.

    Args:
        name: Name of the sensor.
        uid: Name of the pad in observations.
        link: Name of the link that carries its gel.
        options: Fields to change, by dotted name.
        imperfections: Amounts of the imperfections, by name.

    Raises:
        UnknownNameError: A sensor, field or imperfection is unknown; the message lists the known ones.
        InvalidArgumentError: A value is not allowed.
    """
    if own := {"uid", "link"} & set(options or {}):
        raise InvalidArgumentError(f"tactile options {sorted(own)} are set by the robot; leave them out")
    standard = sensor_config(name, uid, link)
    config = with_options(standard, _fitting_the_gel(standard, options or {}))
    if "optics.calibration" in (options or {}) and config.optics.lights is not None:
        raise InvalidArgumentError(
            f"tactile option 'optics.calibration': the colours of sensor {name!r} are computed from its lamps, and no "
            "calibration would be read; give 'optics.lights': None, too"
        )
    known = [entry.name for entry in dataclasses.fields(config.imperfections)]
    if not isinstance(imperfections or {}, Mapping):
        raise InvalidArgumentError(f"imperfections={imperfections!r} must be a dict of amounts by name; names are {known}")
    if unknown := [str(one) for one in imperfections or {} if one not in known]:
        raise UnknownNameError(f"imperfections {unknown} are unknown; choose from {known}")
    return with_options(config, {f"imperfections.{one}": value for one, value in (imperfections or {}).items()})


def _fitting_the_gel(standard: TactileSensorConfig, options: Mapping[str, Any]) -> Mapping[str, Any]:
    """The options of a pad, with an image and a force field that fit a smaller gel, unless the options give these, too.

    Args:
        standard: Configuration of the sensor without the options.
        options: Fields to change, by dotted name; values of wrong types are left as they are.

    Raises:
        InvalidArgumentError: The gel is smaller than one taxel.
    """
    size = options.get("gel.size")
    if not (isinstance(size, Sequence) and len(size) == 2 and all(map(is_number, size))):
        return options
    shapes = {name: tuple(map(min, shape, getattr(standard, name))) for name, shape in grids_for(size, standard).items()}
    return shapes | dict(options)
