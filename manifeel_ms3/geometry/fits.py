"""What goes into what: a held part with a leading end, and the receptacle that takes it."""

from dataclasses import dataclass

import numpy as np

from .part import Part

CORNER_AIM = 0.75  # of a hole's half size, inside its (+x, +y) corner: near its middle, for what the eye may be off
LEAD = 0.0007  # m that a leaning plug's corner can go down before its other side meets the hole's
LEANS = (np.deg2rad(5.0), np.deg2rad(12.0))


@dataclass(frozen=True)
class Fit:
    """A plug and its socket, for insertion.

    Frames: the plug's has its z along the insertion (down, when inserted) and its origin on the axis of what is held; the
    socket's lies in the middle of its underside, z up. Lengths in m.
    """

    plug: Part
    socket: Part
    reach: float
    """From the plug's origin to its foremost face, along its z."""
    grip: float
    """From the plug's origin to between the pads, along its z."""
    grip_width: float
    """Of what the pads close on, along the plug's y."""
    rim: float
    """Height of the socket's rim over its underside."""
    floor: float
    """Height of the plug's foremost face over the socket's underside when it is all the way in."""
    corner: tuple[float, float]
    """Where the first of the foremost face finds its way in when the plug leans towards it: (x, y) from the socket's axis when
    the plug is in."""
    aim: tuple[float, float]
    """Where to set that point down, (x, y) from the socket's axis: well within what takes it."""
    lean: tuple[float, float]
    """How far the plug leans so that this point goes ahead: rad, along x and along y."""
    clearance: float = 1e-3
    """How far off its axis a plug that is in can be."""

    @staticmethod
    def into_hole(
        prong: tuple[float, float], hole: tuple[float, float], at: tuple[float, float] = (0.0, 0.0)
    ) -> dict[str, tuple[float, float]]:
        """`corner`, `aim` and `lean` of a prong of half sizes `prong` that finds the (+x, +y) corner of a hole at `at`."""
        corner = (at[0] + prong[0], at[1] + prong[1])
        aim = (at[0] + (1 - CORNER_AIM) * hole[0], at[1] + (1 - CORNER_AIM) * hole[1])
        lean = tuple(float(np.clip(np.arctan(LEAD / ((2 - CORNER_AIM) * half)), *LEANS)) for half in hole)
        return dict(corner=corner, aim=aim, lean=lean)

    @property
    def depth(self) -> float:
        return self.rim - self.floor
