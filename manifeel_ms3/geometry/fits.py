"""Fits: a held plug with a leading end, and the socket that takes it."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .part import Part

CORNER_AIM = 0.75
"""Distance of the first landing place from a hole's (+x, +y) corner, as a share of its half size: near the hole's middle, which
allows for the error of sight. Tuned."""
FITS = ("paper", "tight")
"""Names of the fits of the insertion tasks: the sizes of the paper's public parts, and a harder one with less play."""
LEAD = 0.0007
"""Depth, in m, that a leaning plug's corner can reach before its other side meets the hole's. Tuned."""
ABOVE_RIM = -0.002
"""Depth, in m, from which on the first pair of faces may meet: the plug's end is seen and held a little wrong. Tuned."""
LEAD_SPAN = 0.003
"""Depth, in m, over which the contact of a pair that meets tells a direction; beyond it the one is in the other."""
LEANS = (np.deg2rad(5.0), np.deg2rad(12.0))
"""Smallest and largest lean, in rad. Tuned."""


UNSEATED_SHARE = 0.1
"""Share of the depth that may be left for a plug to count as inserted: nine tenths of the way in. Our choice; the public code
judges by key points instead."""


@dataclass(frozen=True)
class Lead:
    """A pair of faces, one of the plug and one of the socket, that is the first to meet from a certain depth on."""

    depth: float
    """Depth of the foremost face below the rim, in m, from which on this pair is the first to meet."""
    middle: tuple[float, float] = (0.0, 0.0)
    """Middle of the pair in the plug's frame, (x, y) in m: a contact beside it tells to which side the plug is off."""
    tells: tuple[float, float] = (1.0, 1.0)
    """For x and for y, 1 if the place of a contact shows the direction of the plug's offset along that axis, else 0."""
    is_pin_below: bool = False
    """Whether the plug has the hole and the socket the pin."""


@dataclass(frozen=True)
class Fit:
    """A plug and its socket, for insertion.

    Frames: the plug's has its z along the insertion (down, when inserted) and its origin on the axis of what is held; the
    socket's lies in the middle of its underside, z up. Lengths in m.
    """

    plug: Part
    socket: Part
    reach: float
    """Distance from the plug's origin to its foremost face, along its z."""
    grip: float
    """Position between the pads relative to the plug's origin, along its z."""
    grip_width: float
    """Width that the pads close on, along the plug's y."""
    rim: float
    """Height of the socket's rim over its underside."""
    floor: float
    """Height of the plug's foremost face over the socket's underside when it is all the way in."""
    corner: tuple[float, float]
    """Point of the foremost face that enters first when the plug leans towards it: (x, y) from the socket's axis when the
    plug is in."""
    aim: tuple[float, float]
    """Place where `corner` is set down, (x, y) from the socket's axis: well within the hole."""
    lean: tuple[float, float]
    """Lean of the plug along x and along y, in rad, with which `corner` goes ahead."""
    clearance: float = 1e-3
    """Largest distance from the socket's axis of a plug that is in."""
    max_gap: float = 1e-3
    """Largest distance of the foremost face from its place over the socket's floor, of a plug that is in."""
    goes_in_upright: bool = False
    """Whether the play is so wide that the plug can be lowered in upright; where it is not, its corner must be led in."""

    leads: tuple[Lead, ...] = ()
    """Pairs that meet as a plug goes in upright, by rising depth."""

    def lead_at(self, depth: float) -> Lead | None:
        """The pair that meets when the foremost face is `depth`, in m, below the rim; None where none does."""
        meeting = [lead for lead in self.leads if lead.depth <= depth < lead.depth + LEAD_SPAN]
        return meeting[-1] if meeting else None

    @staticmethod
    def into_hole(
        prong: tuple[float, float], hole: tuple[float, float], at: tuple[float, float] = (0.0, 0.0)
    ) -> dict[str, Any]:
        """`corner`, `aim` and `lean` of a prong that finds the (+x, +y) corner of a hole.

        Args:
            prong: Half sizes of the prong.
            hole: Half sizes of the hole.
            at: Centre of the hole, from the socket's axis.
        """
        corner = (at[0] + prong[0], at[1] + prong[1])
        aim = (at[0] + (1 - CORNER_AIM) * hole[0], at[1] + (1 - CORNER_AIM) * hole[1])
        lean = tuple(float(np.clip(np.arctan(LEAD / ((2 - CORNER_AIM) * half)), *LEANS)) for half in hole)
        return dict(corner=corner, aim=aim, lean=lean)

    @property
    def depth(self) -> float:
        """Depth of the socket."""
        return self.rim - self.floor
