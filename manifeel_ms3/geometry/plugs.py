"""Pegs with their sockets: the peg of the paper's public code, and that of the reorientation task."""

from dataclasses import dataclass

from manifeel_ms3.arguments import one_of
from manifeel_ms3.rendering.looks import BLUE_PLASTIC, BRASS

from . import materials
from .fits import UNSEATED_SHARE, Fit, MeetingFaces
from .part import Box, Part, block_with_chamfered_holes, block_with_holes

PEG_SIZE = (0.01196, 0.00791, 0.050)
"""Size of the peg, in m (measured in the mesh of the public code; its length is set once)."""


@dataclass(frozen=True)
class PegSocket:
    """Sizes of the peg's socket, a square block on the table, in m."""

    hole: tuple[float, float]
    """Size of the hole along x and y."""
    depth: float
    """Depth of the hole."""
    chamfer: float
    """Width of the chamfer around the hole's mouth."""
    plate: tuple[float, float]
    """Side and thickness of the square plate below the block, which is the hole's floor; where it is 0 thick, the
    table is the floor."""
    grip: float
    """Distance of the middle between the pads from the peg's middle, so that the fingers stay clear of the block."""


PEG_SOCKETS = {
    "paper": PegSocket((0.0130, 0.0090), 0.025, 0.001, (0.040, 0.003), 0.022),  # measured in the mesh of the public code
    "tight": PegSocket((0.012, 0.008), 0.009, 0.0, (0.025, 0.0), 0.014),  # 0.04 and 0.09 mm wider than the peg
}
"""Sizes of the peg's socket by the name of the fit."""
PEG_BLOCK = (0.025, 0.025)
"""Size of the socket's block along x and y, in m. Chosen by eye."""


def peg_fit(fit: str = "paper") -> Fit:
    """Rectangular peg, 50 mm long, and its socket.

    Args:
        fit: "paper" for a hole of 13 x 9 mm with a chamfer, 25 mm deep; "tight" for one of 12 x 8 mm, 9 mm deep.
    """
    socket = PEG_SOCKETS[one_of("fit", fit, PEG_SOCKETS)]
    side, floor = socket.plate
    block = block_with_chamfered_holes(PEG_BLOCK, socket.depth, [(socket.hole, (0.0, 0.0))], floor, socket.chamfer)
    plate = (Box((side, side, floor), (0.0, 0.0, floor / 2)),) if floor else ()
    return Fit(
        plug=Part("peg", (Box(PEG_SIZE),), look=BRASS, density=materials.BRASS),
        socket=Part("socket", (*block, *plate), look=BLUE_PLASTIC),
        reach=PEG_SIZE[2] / 2,
        grip=-socket.grip,
        grip_width=PEG_SIZE[1],
        rim=floor + socket.depth,
        floor=floor,
        goes_in_upright=fit == "paper",
        pin=(PEG_SIZE[0] / 2, PEG_SIZE[1] / 2),
        hole=(socket.hole[0] / 2, socket.hole[1] / 2),
        meeting_faces=(MeetingFaces(),),
    )


REORIENTATION_PEG = (0.016, 0.010, 0.050)
"""Size of the reorientation task's peg, in m. Set once; not tuned."""
REORIENTATION_GAP, RIM_DEPTH, RIM_BOTTOM = 2e-4, 0.015, 0.005
"""Gap on each side of the peg in the rim, depth of the rim, and thickness of its bottom, in m. Set once; not tuned."""
RIM_SIZE = (0.03, 0.03)
"""Outer size of the rim along x and y, in m. Set once; not tuned."""
REORIENTATION_GRIP = -0.018
"""Distance of the middle between the pads from the peg's middle, in m: the fingers stay clear of the rim at a pitch of 30
degrees."""


def reorientation_fit() -> Fit:
    """Peg of 16 x 10 x 50 mm, and a rim 15 mm deep that takes it with a gap of 0.2 mm on each side."""
    x, y, z = REORIENTATION_PEG
    hole = (x + 2 * REORIENTATION_GAP, y + 2 * REORIENTATION_GAP)
    base = Box((*RIM_SIZE, RIM_BOTTOM), (0.0, 0.0, RIM_BOTTOM / 2))
    rim = block_with_holes(RIM_SIZE, RIM_DEPTH, [(hole, (0.0, 0.0))], bottom=RIM_BOTTOM)
    return Fit(
        plug=Part("peg", (Box(REORIENTATION_PEG),), look=BRASS, density=materials.BRASS),
        socket=Part("rim", (base, *rim), look=BLUE_PLASTIC),
        reach=z / 2,
        grip=REORIENTATION_GRIP,
        grip_width=y,
        rim=RIM_BOTTOM + RIM_DEPTH,
        floor=RIM_BOTTOM,
        max_gap=UNSEATED_SHARE * RIM_DEPTH,
        pin=(x / 2, y / 2),
        hole=(hole[0] / 2, hole[1] / 2),
    )
