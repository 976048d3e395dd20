"""What goes into what: a held part with a leading end, and the receptacle that takes it."""

from dataclasses import dataclass

from .part import Part


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
    guide: tuple[float, float]
    """Half sizes (x, y) of the prong that finds its hole first."""
    guide_hole: tuple[float, float]
    """Half sizes (x, y) of that hole."""
    guide_at: tuple[float, float] = (0.0, 0.0)
    """Centre (x, y) of that hole in the socket's frame."""
    clearance: float = 1e-3
    """How far off its axis a plug that is in can be."""

    @property
    def depth(self) -> float:
        return self.rim - self.floor
