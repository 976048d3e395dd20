"""Fits: pairs of a held plug and the socket that takes it, and what a demonstrator must know to join them."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .part import Part

CORNER_AIM = 0.75
"""Distance of the place where a leaning plug's corner is first set down from the hole's (+x, +y) corner, as a share of the
hole's half size: near its middle, which allows for the error of sight. Tuned."""
FITS = ("paper", "tight")
"""Names of the fits of the insertion tasks: the sizes of the paper's public parts, and a harder one with less play."""
LEAD = 0.0007
"""Depth, in m, that a leaning plug's corner can reach before its other side meets the hole's. Tuned."""
ABOVE_RIM = -0.002
"""Depth below the rim, in m, from which on the first pair of faces may meet: the place of the plug's end is not known exactly.
Tuned."""
LEAD_SPAN = 0.003
"""Depth, in m, over which the contact of a pair of faces tells a direction; deeper, the pin is in the hole. Set once;
not tuned."""
LEANS = (np.deg2rad(5.0), np.deg2rad(12.0))
"""Smallest and largest lean of a plug whose corner goes ahead, in rad. Tuned."""
UNSEATED_SHARE = 0.1
"""Share of the depth that may be left for a plug to count as inserted: nine tenths of the way in. Our choice; the public code
judges by key points instead."""


@dataclass(frozen=True)
class Lead:
    """A pair of faces, one of the plug and one of the socket, that meets first from a certain depth on."""

    depth: float
    """Depth of the foremost face below the rim, in m, from which on this pair meets first."""
    middle: tuple[float, float] = (0.0, 0.0)
    """Middle of the pair in the plug's frame, (x, y) in m: the side of a contact shows to which side the plug is off."""
    tells: tuple[float, float] = (1.0, 1.0)
    """For x and for y, 1 if the place of a contact shows the direction of the plug's offset along that axis, else 0."""
    is_pin_below: bool = False
    """Whether the plug has the hole and the socket the pin."""


@dataclass(frozen=True)
class Fit:
    """A plug and its socket, for insertion.

    Frames: the plug's has its z along the insertion (down, when inserted) and its origin on the axis of the part that is held;
    the socket's lies in the middle of its underside, z up. Lengths are in m.
    """

    plug: Part
    """The held part."""
    socket: Part
    """The fixed part."""
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
    """Largest distance from the socket's axis at which the plug counts as inserted. Our choice."""
    max_gap: float = 1e-3
    """Largest distance of the foremost face over `floor` at which the plug counts as inserted. Our choice."""
    goes_in_upright: bool = False
    """Whether the play is so wide that the plug can be lowered in upright; where it is not, its corner must go ahead."""
    leads: tuple[Lead, ...] = ()
    """Pairs of faces that meet as a plug goes in upright, by rising depth."""

    def lead_at(self, depth: float) -> Lead | None:
        """Pair of faces that meets when the foremost face is `depth`, in m, below the rim; None if none does."""
        meeting = [lead for lead in self.leads if lead.depth <= depth < lead.depth + LEAD_SPAN]
        return meeting[-1] if meeting else None

    @staticmethod
    def into_hole(
        prong: tuple[float, float], hole: tuple[float, float], at: tuple[float, float] = (0.0, 0.0)
    ) -> dict[str, Any]:
        """`corner`, `aim` and `lean` of a fit whose prong finds the (+x, +y) corner of a hole.

        Args:
            prong: Half sizes of the prong along x and y.
            hole: Half sizes of the hole along x and y.
            at: Centre of the hole, (x, y) from the socket's axis.
        """
        corner = (at[0] + prong[0], at[1] + prong[1])
        aim = (at[0] + (1 - CORNER_AIM) * hole[0], at[1] + (1 - CORNER_AIM) * hole[1])
        lean = tuple(float(np.clip(np.arctan(LEAD / ((2 - CORNER_AIM) * half)), *LEANS)) for half in hole)
        return dict(corner=corner, aim=aim, lean=lean)

    @property
    def depth(self) -> float:
        """Depth of the socket."""
        return self.rim - self.floor
