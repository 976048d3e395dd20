"""Fits: pairs of a held plug and the socket that takes it."""

from dataclasses import dataclass

from .part import Part

FITS = ("paper", "tight")
"""Names of the fits of the insertion tasks: the sizes of the paper's public parts, and a harder one with less play."""
UNSEATED_SHARE = 0.1
"""Share of the depth that may be left for a plug to count as inserted: nine tenths of the way in. Our choice; the public code
judges by key points instead."""


@dataclass(frozen=True)
class MeetingFaces:
    """A pair of faces, one of the plug and one of the socket, that meet where a plug that goes in upright is off the axis."""

    depth: float = 0.0
    """Depth of the foremost face below the rim, in m, at which they meet."""
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
    pin: tuple[float, float]
    """Half sizes along x and y of the pin that enters first; its radius, twice, if it is round."""
    hole: tuple[float, float]
    """The same sizes of the hole that takes it."""
    hole_at: tuple[float, float] = (0.0, 0.0)
    """Centre of the hole, (x, y) from the socket's axis."""
    clearance: float = 1e-3
    """Largest distance from the socket's axis at which the plug counts as inserted. Our choice."""
    max_gap: float = 1e-3
    """Largest distance of the foremost face over `floor` at which the plug counts as inserted. Our choice."""
    goes_in_upright: bool = False
    """Whether the play is so wide that the plug can be lowered in upright; where it is not, its corner must go ahead."""
    meeting_faces: tuple[MeetingFaces, ...] = ()
    """Pairs of faces that meet as a plug goes in upright, by rising depth: the rim's, then those of a pin in the socket."""

    @property
    def depth(self) -> float:
        """Depth of the socket."""
        return self.rim - self.floor
