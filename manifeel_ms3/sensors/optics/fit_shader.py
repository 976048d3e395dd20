"""Fit the compact shader to a sensor: `python -m manifeel_ms3.sensors.optics.fit_shader {table,presses,pack} ...`.

The input is either a table in Taxim's format, or images of a ball of known radius that is pressed into the gel. The images come
as a folder with `background.png` (the untouched gel) and `presses.csv` (columns `file,row,col,radius`: the contact circle in
pixels), or as one file in Taxim's format, `dataPack.npz`.
"""

import csv
import sys
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import tyro

from manifeel_ms3.arguments import require_file
from manifeel_ms3.command_line import run
from manifeel_ms3.errors import InvalidArgumentError, InvalidFileError
from manifeel_ms3.files import read_npz

from .shader import FOURIER_TERMS, KNOTS, PLACE_TERMS, Shader, fourier_terms, place_terms, slope_terms
from .taxim_table import fit_table, read_table

SHIFTS = (8, 4, 2)  # pixels: steps of the search for a circle's middle, which moves by up to two steps of each size (chosen)
RIDGE = 1e-6  # share of the mean diagonal (chosen): coefficients of slopes and places that no press reached stay at zero


@dataclass
class Table:
    """Fit the shader to a polycalib.npz in Taxim's format."""

    table: Path
    """Path of the table: an npz file with grad_r, grad_g and grad_b, each (bins, bins, 6)."""
    out: Path
    """Path of the shader file that is written."""
    image_shape: tuple[int, int] = (240, 320)
    """Rows and columns of the sensor's image, which is the table's image turned by a quarter."""


@dataclass(kw_only=True)
class BallPresses:
    """Options of a fit to ball presses, without their images."""

    ball_radius: float
    """Radius of the ball, m."""
    pixel_size: float
    """Size of a pixel on the gel's face, m."""
    out: Path
    """Path of the shader file that is written."""
    uniform: bool = False
    """Fit the same colour changes to the whole image, for presses that cover only a part of it. Changes that are the same for
    all directions of the slope are then taken for an effect of depth, and left out."""
    refine: bool = False
    """Shift each contact circle to where the colours of the other presses fit best, for circles that were drawn by hand."""


@dataclass(kw_only=True)
class Presses(BallPresses):
    """Fit the shader to images of ball presses."""

    folder: Path
    """Path of the folder with background.png, presses.csv and the images."""


@dataclass(kw_only=True)
class Pack(BallPresses):
    """Fit the shader to the images of ball presses in a dataPack.npz in Taxim's format."""

    pack: Path
    """Path of the file: an npz with f0, imgs (BGR), touch_center (column, row) and touch_radius (pixels)."""


def fit_presses(
    background: np.ndarray,
    images: np.ndarray,
    circles: np.ndarray,
    ball_radius: float,
    pixel_size: float,
    uniform: bool = False,
) -> Shader:
    """Shader of a gel, fitted to presses of a ball.

    Within a contact circle the gel has the ball's shape, so that each pixel there is a sample of slope, direction and place.

    Args:
        background: (H, W, 3), RGB image of the untouched gel.
        images: (P, H, W, 3), RGB images of presses.
        circles: (P, 3), row, column and radius of the contact, pixels.
        ball_radius: Radius of the ball, m.
        pixel_size: Size of a pixel on the gel's face, m.
        uniform: Whether the same colour changes are fitted to the whole image, without those that are independent of the
            slope's direction.

    Raises:
        InvalidArgumentError: A contact circle is larger than the ball, empty or outside the image, a size is not above 0, or
            the images have different shapes.
    """
    rows, cols = background.shape[:2]
    if min(ball_radius, pixel_size) <= 0:
        raise InvalidArgumentError(f"ball_radius={ball_radius} and pixel_size={pixel_size} are lengths in m, above 0")
    if images.shape[1:] != background.shape:
        raise InvalidArgumentError(
            f"the images have shape {images.shape[1:]} and the background {background.shape}; they must be the same"
        )
    if (circles[:, 2] * pixel_size >= ball_radius).any():
        raise InvalidArgumentError(
            f"a contact circle of {circles[:, 2].max()} pixels is larger than the ball; correct ball_radius or pixel_size"
        )
    row, col, place = _pixels(rows, cols)
    # the first term over places, and over directions, is 1
    first, used = (1, 1) if uniform else (0, PLACE_TERMS)
    columns = (FOURIER_TERMS - first) * (len(KNOTS) - 1) * used
    normal, right = np.zeros((columns, columns)), np.zeros((columns, 3))
    for image, (middle_row, middle_col, radius) in zip(images, circles, strict=True):
        inside, slope, phi = _pressed(row - middle_row, col - middle_col, radius, ball_radius, pixel_size)
        if radius <= 0 or not inside.any():
            raise InvalidArgumentError(
                f"the contact circle at row {middle_row:g} and column {middle_col:g} with a radius of {radius:g} pixels covers "
                f"nothing of an image of {rows} rows and {cols} columns; correct the list of presses"
            )
        terms = (fourier_terms(phi)[:, first:], slope_terms(slope), place[inside, :used])
        design = np.einsum("nf,nk,nq->nfkq", *terms).reshape(-1, columns)
        normal += design.T @ design
        right += design.T @ (image[inside].astype(float) - background[inside])
    weights = np.linalg.solve(normal + RIDGE * np.trace(normal) / columns * np.eye(columns), right)
    flat = np.linalg.lstsq(place.reshape(-1, PLACE_TERMS), background.reshape(-1, 3).astype(float), rcond=None)[0]
    fitted = np.zeros((3, FOURIER_TERMS, len(KNOTS) - 1, PLACE_TERMS))
    fitted[:, first:, :, :used] = weights.T.reshape(3, FOURIER_TERMS - first, len(KNOTS) - 1, used)
    return Shader(fitted, flat.T)


def _pixels(rows: int, cols: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row and column (H, W) of every pixel, and the place terms (H, W, 6) there."""
    row, col = np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij")
    return row, col, place_terms(2 * row / (rows - 1) - 1, 2 * col / (cols - 1) - 1)


def _pressed(
    row: np.ndarray, col: np.ndarray, radius: float, ball_radius: float, pixel_size: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (H, W) within a contact circle of `radius` pixels, and the gradient's size and direction (n,) in them.

    `row` and `col` (H, W) are distances from the circle's middle, pixels.
    """
    y, x = row * pixel_size, col * pixel_size
    r2 = x * x + y * y
    inside = r2 < (radius * pixel_size) ** 2
    slope = np.sqrt(r2[inside] / (ball_radius**2 - r2[inside]))
    return inside, slope, np.arctan2(-x[inside], -y[inside])  # the surface rises, into the gel, towards the middle


def refined_circles(
    background: np.ndarray,
    images: np.ndarray,
    circles: np.ndarray,
    ball_radius: float,
    pixel_size: float,
    uniform: bool = False,
) -> np.ndarray:
    """Contact circles (P, 3), shifted to where a shader that is fitted to one half of the presses fits the other half best.

    The arguments are those of `fit_presses`.

    Raises:
        InvalidArgumentError: There is only one press, or `fit_presses` refuses the arguments.
    """
    if len(images) < 2:
        raise InvalidArgumentError(
            "one press alone cannot be refined, because its circle is shifted to where the colours of other presses fit best; "
            "give more presses, or leave out --refine"
        )
    circles, (row, col, place) = circles.astype(float), _pixels(*background.shape[:2])

    def misfit(shader: Shader, press: int, middle: np.ndarray) -> float:
        inside, slope, phi = _pressed(row - middle[0], col - middle[1], circles[press, 2], ball_radius, pixel_size)
        terms = (fourier_terms(phi), slope_terms(slope), place[inside])
        change = np.einsum("cfkq,nf,nk,nq->nc", shader.weights, *terms, optimize=True)
        return float((change - (images[press][inside].astype(float) - background[inside])).var(axis=0).sum())

    for step in SHIFTS:
        grid = step * np.array(list(product(range(-2, 3), repeat=2)))
        for half in (0, 1):
            shader = fit_presses(background, images[1 - half :: 2], circles[1 - half :: 2], ball_radius, pixel_size, uniform)
            for press in range(half, len(images), 2):
                middles = circles[press, :2] + grid
                circles[press, :2] = min(middles, key=lambda middle, p=press, s=shader: misfit(s, p, middle))
    return circles


def read_presses(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Background, images and circles of a folder, in the form that `fit_presses` expects.

    Raises:
        InvalidFileError: A file is missing, cannot be read or has another size than the background, or the list of presses
            lacks columns, presses or numbers.
    """
    listing = folder / "presses.csv"
    if not listing.is_file():
        raise InvalidFileError(f"{listing} does not exist; it must list file,row,col,radius of every press")
    try:
        presses = list(csv.DictReader(listing.read_text(encoding="utf-8-sig").splitlines()))
    except UnicodeDecodeError as error:
        raise InvalidFileError(f"{listing} is not text in UTF-8 ({error}); save it in that encoding") from error
    if not presses or not {"file", "row", "col", "radius"} <= set(presses[0]):
        raise InvalidFileError(f"{listing} must have the columns file, row, col, radius and at least one press")
    circles = np.array([_circle_of(press, listing) for press in presses])
    background, images = _read_image(folder / "background.png"), [_read_image(folder / press["file"]) for press in presses]
    for press, image in zip(presses, images, strict=True):
        if image.shape != background.shape:
            raise InvalidFileError(
                f"{folder / press['file']} has {image.shape[1]} x {image.shape[0]} pixels, background.png "
                f"{background.shape[1]} x {background.shape[0]}; give images of one size"
            )
    return background, np.stack(images), circles


def _circle_of(press: dict[str, str | None], listing: Path) -> list[float]:
    """Row, column and radius of a press's contact circle, pixels.

    Raises:
        InvalidFileError: A cell of the press is missing or is no finite number.
    """
    try:
        circle = [float(press[name] or "") for name in ("row", "col", "radius")]
        if press["file"] and np.isfinite(circle).all():
            return circle
    except ValueError:
        pass
    raise InvalidFileError(
        f"{listing} has the press {press}; it must have the name of a file, and numbers of pixels as row, col and radius"
    )


def read_pack(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Background, images and circles of a dataPack.npz, in the form that `fit_presses` expects.

    Raises:
        InvalidFileError: The file is missing or does not have Taxim's format.
    """
    kind = "a dataPack.npz in Taxim's format, with f0, imgs, touch_center and touch_radius"
    background, images, centres, radii = read_npz(path, kind, ("f0", "imgs", "touch_center", "touch_radius")).values()
    try:
        circles = np.column_stack([centres[:, ::-1], radii]).astype(float)
    except (ValueError, IndexError) as error:
        raise InvalidFileError(f"{path} is not {kind} ({error})") from error
    if background.ndim != 3 or images.shape != (len(circles), *background.shape) or background.shape[2] != 3:
        raise InvalidFileError(
            f"{path} is not {kind}: f0 has the shape {background.shape}, imgs {images.shape}, and there are {len(circles)} "
            "circles; f0 must be (H, W, 3), and imgs one such image for each circle"
        )
    return background[..., ::-1], images[..., ::-1], circles


def _read_image(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    if image is None:
        raise InvalidFileError(f"{path} is missing or is not an image")
    return image[..., ::-1]


def main(args: Table | Presses | Pack) -> None:
    """Fit a shader and write it."""
    require_file("--out", args.out, "shader.npz")
    if isinstance(args, Table):
        shader = fit_table(read_table(args.table), args.image_shape)
    else:
        background, images, circles = read_pack(args.pack) if isinstance(args, Pack) else read_presses(args.folder)
        scale = (args.ball_radius, args.pixel_size, args.uniform)
        if args.refine:
            circles = refined_circles(background, images, circles, *scale)
        shader = fit_presses(background, images, circles, *scale)
    shader.save(args.out)


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Table | Presses | Pack)))
