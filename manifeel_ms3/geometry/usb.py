"""A USB-A plug on a handle, and the port that takes it only one way round."""

from dataclasses import dataclass

from manifeel_ms3.arguments import one_of
from manifeel_ms3.rendering import looks

from .fits import UNSEATED_SHARE, Fit, MeetingFaces
from .materials import STEEL
from .part import Box, Part, Piece, block_with_holes

HANDLE = (0.012, 0.030, 0.070)
"""Size of the handle, in m; it is narrower than a pad, so that the pad feels its edges."""
GRIP = -0.012
"""Distance of the middle between the pads from the handle's middle along the plug's z, in m. Set once; not tuned."""
BLOCK, RIM = (0.066, 0.066), 0.037
"""Size of the port's block along x and y, and its height, in m. Set once; not tuned."""


@dataclass(frozen=True)
class USBSizes:
    """Sizes of plug and port, in m.

    "Wide" and "thin" are the two directions of the shell's section; the insulator lies towards negative thin.
    """

    shell: tuple[float, float, float]
    """Outer size of the shell along wide and thin, and its length."""
    wall: float
    """Thickness of the shell's sheet."""
    insulator: tuple[float, float]
    """Size of the insulator in the shell along wide and thin."""
    port: tuple[float, float, float]
    """Size of the port along wide and thin, and its depth."""
    tongue: tuple[float, float]
    """Size of the port's tongue along wide and thin."""
    tongue_at: float
    """Position of the tongue's middle along thin; the tongue fits into the shell's free half."""
    recess: float
    """Distance of the tongue's end from the port's mouth."""
    wide_axis: int
    """Axis along which the shell is wide: 0 for x, 1 for y, the fingers' closing axis."""
    windows: tuple[float, float, float, float] | None = None
    """The two latch windows in each broad face: where they begin and end along the shell, their width, and the distance of
    their middles from the shell's middle; None if there are none."""


SIZES = {
    # 1.8 times the standard, measured in the meshes of the public code; the tongue's place along thin is in the middle of
    # the shell's free half
    "paper": USBSizes(
        shell=(0.0220, 0.0060, 0.0200),
        wall=0.0006,
        insulator=(0.0200, 0.0020),
        port=(0.0234, 0.00918, 0.0183),
        tongue=(0.01764, 0.00198),
        tongue_at=0.0010,
        recess=0.0015,
        wide_axis=1,
        windows=(0.0075, 0.0100, 0.0045, 0.0046),  # their width and distance are chosen by eye
    ),
    # USB-A plug (USB 2.0, 6.7) with 0.1 mm of play on each side
    "tight": USBSizes(
        shell=(0.0120, 0.0045, 0.0120),
        wall=0.0003,
        insulator=(0.0114, 0.0020),
        port=(0.0122, 0.0047, 0.0120),
        tongue=(0.0112, 0.0017),
        tongue_at=0.0010,
        recess=0.0030,
        wide_axis=0,
    ),
}
"""Sizes by the name of the fit."""


def usb_fit(fit: str = "paper") -> Fit:
    """USB-A plug on a handle 12 x 30 x 70 mm, and a port in a block 66 x 66 x 37 mm. It goes in only one way round.

    Args:
        fit: "paper" for 1.8 times the standard's size with 0.4 to 0.7 mm of play on each side; "tight" for the standard's size.
    """
    sizes = SIZES[one_of("fit", fit, SIZES)]
    floor = RIM - sizes.port[2]
    shell = _shell(sizes)
    hole, prong = _along(sizes, *sizes.port[:2]), _along(sizes, *sizes.shell[:2])
    walls = block_with_holes(BLOCK, sizes.port[2], [(hole, (0.0, 0.0))], bottom=floor)
    base = Box((*BLOCK, floor), (0.0, 0.0, floor / 2))
    length = sizes.port[2] - sizes.recess
    tongue = _box(sizes, (*sizes.tongue, length), (0.0, sizes.tongue_at, floor + length / 2))
    # the y axis of a plug that points down is reversed, so that the tongue must be mirrored in y
    tongue = Box(tongue.size, (tongue.centre[0], -tongue.centre[1], tongue.centre[2]))
    pieces: tuple[Piece, ...] = (Box(HANDLE), *shell)
    sheets = dict.fromkeys(range(2, len(pieces)), STEEL)
    return Fit(
        plug=Part(
            "usb_plug", pieces, looks.STEEL, other_looks={0: looks.DARK_PLASTIC, 1: looks.WHITE_PLASTIC}, other_densities=sheets
        ),
        socket=Part("usb_port", (tongue, base, *walls), looks.BLUE_PLASTIC, other_looks={0: looks.WHITE_PLASTIC}),
        reach=HANDLE[2] / 2 + sizes.shell[2],
        grip=GRIP,
        grip_width=HANDLE[1],
        rim=RIM,
        floor=floor,
        max_gap=UNSEATED_SHARE * sizes.port[2],
        goes_in_upright=fit == "paper",
        pin=(prong[0] / 2, prong[1] / 2),
        hole=(hole[0] / 2, hole[1] / 2),
        meeting_faces=(
            MeetingFaces(),
            MeetingFaces(sizes.recess, _along(sizes, 0.0, sizes.tongue_at), _along(sizes, 0.0, 1.0), is_pin_below=True),
        ),
    )


def _along(sizes: USBSizes, wide: float, thin: float) -> tuple[float, float]:
    """The (x, y) of a pair (wide, thin)."""
    return (wide, thin) if sizes.wide_axis == 0 else (thin, wide)


def _box(sizes: USBSizes, size: tuple[float, float, float], centre: tuple[float, float, float]) -> Box:
    """A box from its (wide, thin, length) and its centre in the same axes."""
    return Box((*_along(sizes, *size[:2]), size[2]), (*_along(sizes, *centre[:2]), centre[2]))


def _shell(sizes: USBSizes) -> list[Box]:
    """Insulator and the shell's four sheets, the broad ones with their windows; the insulator comes first."""
    wide, thin, long = sizes.shell
    bottom, middle = HANDLE[2] / 2, HANDLE[2] / 2 + long / 2
    insulator = (*sizes.insulator, long)
    boxes = [_box(sizes, insulator, (0.0, -thin / 2 + sizes.wall + sizes.insulator[1] / 2, middle))]
    for side in (-1, 1):
        boxes.append(_box(sizes, (sizes.wall, thin, long), (side * (wide - sizes.wall) / 2, 0.0, middle)))
        at = side * (thin - sizes.wall) / 2
        for (left, right), (low, high) in _sheet(sizes):
            size = (right - left, sizes.wall, high - low)
            boxes.append(_box(sizes, size, ((left + right) / 2, at, bottom + (low + high) / 2)))
    return boxes


def _sheet(sizes: USBSizes) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Rectangles ((left, right), (low, high)), in m along wide and along the shell, of a broad face around its windows."""
    half, long = sizes.shell[0] / 2, sizes.shell[2]
    if sizes.windows is None:
        return [((-half, half), (0.0, long))]
    low, high, width, at = sizes.windows
    edges = (-half, -at - width / 2, -at + width / 2, at - width / 2, at + width / 2, half)
    beside = [((edges[k], edges[k + 1]), (low, high)) for k in (0, 2, 4)]
    return [((-half, half), (0.0, low)), *beside, ((-half, half), (high, long))]
