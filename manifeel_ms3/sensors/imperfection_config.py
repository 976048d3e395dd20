"""What a real sensor adds to the true signal: amounts of each imperfection, and what an episode draws of them."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from manifeel_ms3.arguments import is_number
from manifeel_ms3.errors import InvalidArgumentError

from .config_fields import amount
from .draws import uniform_draws

FULL_SCALE_FORCE = 0.6  # N per taxel (chosen: images of the force field draw it at full brightness)
FULL_SCALE_LEVEL = 255.0  # grey levels
DRIFT_STEPS = 100  # control steps in which the drift reaches its amount: 10 s at the tasks' 10 Hz
MOST_DELAY = 50  # control steps (chosen: 5 s at the tasks' 10 Hz)
STREAM = 16  # first of the streams of `uniform_draws` that imperfections use; arbitrary


def _pair(name: str, given: Any) -> tuple[float, float]:
    """An amount as the pair (least, most)."""
    pair = (given, given) if is_number(given) else given
    if not isinstance(pair, list | tuple) or len(pair) != 2 or not all(map(is_number, pair)):
        raise InvalidArgumentError(f"imperfections.{name}={given!r} must be a number, or a pair (least, most)")
    return (pair[0], pair[1])


@dataclass
class ImperfectionConfig:
    """Amounts of the imperfections, 0 by default. A pair (least, most) lets each episode draw its own amount from its seed.

    Full scale is 0.6 N for each component of a taxel's force (gel.max_penetration with units="tacsl"), and 255 grey levels.

    Only `delay` and `dead_taxels` affect the observation's `penetration`. It stays free of hysteresis, crosstalk, drift, noise
    and gain, so that a policy whose robustness is tested must not read it.

    Raises:
        InvalidArgumentError: An amount is neither a number nor a pair of numbers, or a delay is not a whole number.
    """

    hysteresis: tuple[float, float] = amount(0.9)
    """Area between loading and unloading, as a share of the area under the loading curve. The reading goes up with the load,
    stays when the load falls, and goes down once it is 1 / (1 - hysteresis) times the load (a play operator)."""
    delay: tuple[float, float] = amount(MOST_DELAY)
    """Number of control steps by which force field, penetration and image are late; a whole number."""
    crosstalk: tuple[float, float] = amount(0.8)
    """Share of a taxel's force that its four neighbours feel instead, a quarter each; sums are kept."""
    dead_taxels: tuple[float, float] = amount(1.0)
    """Share of the taxels that always read zero, in force field and penetration."""
    drift: tuple[float, float] = amount(1.0)
    """Change of the untouched signal after 100 control steps, as a share of full scale, growing steadily; every component of
    every taxel's force and every colour has its own rate between minus and plus this amount."""
    noise: tuple[float, float] = amount(0.5)
    """Standard deviation of the read noise of every component of every taxel and pixel, as a share of full scale."""
    gain: tuple[float, float] = amount(0.9)
    """Relative half width of the taxels' gains; all components of a taxel have the same gain."""

    def __post_init__(self):
        for entry in dataclasses.fields(self):
            setattr(self, entry.name, _pair(entry.name, getattr(self, entry.name)))
        if any(steps % 1 for steps in self.delay):
            raise InvalidArgumentError(f"imperfections.delay={self.delay} must be a whole number of control steps")

    @property
    def is_none(self) -> bool:
        """Whether the sensor is perfect."""
        return not any(most for _, most in dataclasses.astuple(self))

    def draw(self, seeds: np.ndarray, taxel_shape: tuple[int, int]) -> dict[str, np.ndarray]:
        """What the episodes of P seeds (P,) draw.

        Returns:
            `hysteresis`, `crosstalk`, `noise`: (P,) amounts. `delay`: (P,) int. `dead_taxels`: (P, rows, cols) bool. `gain`:
            (P, rows, cols) factors. `drift_force`: (P, rows, cols, 3) and `drift_colour`: (P, 3), share of full scale in
            `DRIFT_STEPS` steps.
        """
        places = taxel_shape[0] * taxel_shape[1]
        amounts = self._amounts(seeds)
        order = np.argsort(uniform_draws(seeds, STREAM + 1, places), axis=1).argsort(axis=1)
        dead = order < np.rint(amounts["dead_taxels"] * places)[:, None]
        gain = 1.0 + amounts["gain"][:, None] * uniform_draws(seeds, STREAM + 2, places)
        drift = amounts["drift"][:, None] * uniform_draws(seeds, STREAM + 3, 3 * places + 3)
        drawn: dict[str, Any] = {name: amounts[name] for name in ("hysteresis", "crosstalk", "noise")}
        return drawn | dict(
            delay=np.floor(amounts["delay"]).astype(np.int64),
            dead_taxels=dead.reshape(-1, *taxel_shape),
            gain=gain.reshape(-1, *taxel_shape),
            drift_force=drift[:, 3:].reshape(-1, *taxel_shape, 3),
            drift_colour=drift[:, :3],
        )

    def _amounts(self, seeds: np.ndarray) -> dict[str, np.ndarray]:
        ranges = dataclasses.asdict(self)
        share = (uniform_draws(seeds, STREAM, len(ranges)) + 1) / 2
        # each whole number of a delay's range is as likely as the others
        width = {name: most - least + (name == "delay" and most > least) for name, (least, most) in ranges.items()}
        return {name: least + width[name] * share[:, k] for k, (name, (least, _)) in enumerate(ranges.items())}
