"""What the numbers of a recorded force field are: their unit follows from the arguments of the environment."""

from collections.abc import Iterable, Mapping
from typing import Any

from manifeel_ms3.arguments import by_name
from manifeel_ms3.sensors.config import TactileSensorConfig, Units
from manifeel_ms3.sensors.registry import DEFAULT_SENSOR, task_sensor
from manifeel_ms3.tasks.checks import split_sensor_configs

MEANING: dict[Units, str] = {
    "newton": "the forces on the taxels, in newtons, in the pad's frame: normal, shear across the finger, and shear along it",
    "tacsl": "TacSL's quantities at the taxels, in the pad's frame: penetration (m), and a tenth of the speed (m/s) at "
    "which the object slides along rows and columns",
}
"""The components of a force field, in a sentence, by unit."""
SUMS: dict[Units, tuple[str, str, str]] = {
    "newton": ("normal, N", "shear across the finger, N", "shear along the finger, N"),
    "tacsl": ("penetration, m", "0.1 x sliding speed across the finger, m/s", "0.1 x sliding speed along the finger, m/s"),
}
"""Names of the sums of a force field's components over the taxels, in the order of its channels, by unit."""


def recorded_sensor(env_kwargs: Mapping[str, Any], pad: str) -> TactileSensorConfig:
    """The configuration of a pad in the environment that these arguments make; imperfections are left out.

    Args:
        env_kwargs: Arguments of the environment, as the json beside a trajectory file names them.
        pad: Name of the sensor, such as "tactile_right".

    Raises:
        UnknownNameError: The sensor is of a package that is not installed, or a field is unknown.
        InvalidArgumentError: A value is not allowed.
    """
    options = by_name("tactile", env_kwargs.get("tactile") or {}, '{"units": "tacsl"}')
    given = by_name("sensor_configs", env_kwargs.get("sensor_configs") or {}, 'dict(tactile_right={"units": "tacsl"})')
    _, own = split_sensor_configs({pad: given.get(pad, {})}, (), (pad,))
    return task_sensor(env_kwargs.get("sensor", DEFAULT_SENSOR), pad, pad, {**options, **own[pad]}, None)


def recorded_units(env_kwargs: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Units]:
    """Units of the force fields among a file's observations, by the name of the pad.

    Args:
        env_kwargs: Arguments of the environment.
        keys: Keys of the observations, such as "sensor_data/tactile_right/force_field".

    Raises:
        UnknownNameError: The sensor is of a package that is not installed, or a field is unknown.
        InvalidArgumentError: A value is not allowed.
    """
    pads = [key.split("/")[1] for key in keys if key.endswith("/force_field")]
    return {pad: recorded_sensor(env_kwargs, pad).units for pad in pads}
