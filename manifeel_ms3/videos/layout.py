"""The layout of a video: the title on top, the scene at the left, and camera, touch and the force curve at the right.

Sizes and colours are chosen by eye.
"""

from collections.abc import Iterator

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from .shots import SCENE_SIZE, Shot, Take

BAR = 36
"""Height of the title, in pixels."""
TILE = SCENE_SIZE // 2
"""Height of the images at the right, in pixels."""
GAP = 4
"""Width of the lines between the images, in pixels."""
NARROW, WIDE = TILE, TILE * 4 // 3
"""Widths of the two columns at the right, in pixels: square for the camera, and 4 : 3 as the tactile images are."""
SIZE = (SCENE_SIZE + NARROW + WIDE + 2 * GAP, BAR + 2 * TILE + GAP)
"""Width and height of a video, in pixels."""
MARGINS = (14, 34, 14, 14)
"""Left, upper, right and lower margin of the curve in its tile, in pixels."""
TITLE_SIZE, TIME_SIZE, CAPTION_SIZE, LIMIT_SIZE = 19, 17, 14, 12
"""Sizes of the text, in points."""
TITLE_INSET, SUCCESS_INSET = 12, 90
"""Distance of the title and the time from the video's sides, and of the word "success" from the right side, in pixels."""
CAPTION_AT = (8, 6)
"""Place of a caption in its tile, in pixels."""
CAPTION_PADDING = (5, 4)
"""Margin of the dark background of a caption at the sides, and above and below, in pixels."""
LIMIT_LIFT = 3
"""Height of the text of the force limit over the limit's line, in pixels."""
POINT_RADIUS = 3
"""Radius of the point at the end of the curve, in pixels."""
HEADROOM = 1.1
"""Upper end of the axis of forces, as a multiple of the largest force."""
SMALLEST_AXIS = 5.0
"""Smallest upper end of the axis of forces before `HEADROOM`, in N: smaller forces are noise of the contacts."""
GROUND, PAPER, INK, FAINT = (18, 20, 24), (30, 33, 39), (236, 238, 242), (128, 134, 146)
CURVE, SUCCESS, LIMIT = (255, 170, 70), (110, 210, 130), (200, 90, 90)
"""RGB colours of the background, tiles, text and faint text and lines; of the force curve, success and force limit."""


def video_frames(take: Take) -> Iterator[Image.Image]:
    """The frames of a video, one for each shot."""
    for shot in take.shots:
        yield video_frame(take, shot)


def video_frame(take: Take, shot: Shot) -> Image.Image:
    """One frame of a video: an image of `SIZE` for a shot of a take."""
    frame = Image.new("RGB", SIZE, GROUND)
    _draw_title(ImageDraw.Draw(frame), take, shot.step)
    images = dict(shot.images)
    frame.paste(_fitted(images.pop("scene"), SCENE_SIZE, SCENE_SIZE), (0, BAR))
    left, right = SCENE_SIZE + GAP, SCENE_SIZE + NARROW + 2 * GAP
    upper, lower = BAR, BAR + TILE + GAP
    places = ((left, upper, NARROW), (right, upper, WIDE), (right, lower, WIDE))
    for (caption, image), (x, y, width) in zip(images.items(), places, strict=True):
        tile = _fitted(image, width, TILE)
        _draw_caption(ImageDraw.Draw(tile), caption)
        frame.paste(tile, (x, y))
    frame.paste(_force_curve(take, shot.step), (left, lower))
    return frame


def _draw_title(draw: ImageDraw.ImageDraw, take: Take, step: int) -> None:
    middle = BAR // 2
    draw.text((TITLE_INSET, middle), take.title, INK, _font(TITLE_SIZE), anchor="lm")
    time = f"{step / take.control_freq:.1f} s"
    draw.text((SIZE[0] - TITLE_INSET, middle), time, FAINT, _font(TIME_SIZE), anchor="rm")
    if take.successes[step]:
        draw.text((SIZE[0] - SUCCESS_INSET, middle), "success", SUCCESS, _font(TITLE_SIZE), anchor="rm")


def _fitted(image: np.ndarray, width: int, height: int) -> Image.Image:
    """Tile with an image (H, W, 3) in its middle, as large as fits; sizes in pixels."""
    source = Image.fromarray(image)
    scale = min(width / source.width, height / source.height)
    size = (round(source.width * scale), round(source.height * scale))
    tile = Image.new("RGB", (width, height), PAPER)
    tile.paste(source.resize(size, Image.Resampling.LANCZOS), ((width - size[0]) // 2, (height - size[1]) // 2))
    return tile


def _draw_caption(draw: ImageDraw.ImageDraw, caption: str) -> None:
    font = _font(CAPTION_SIZE)
    left, top, right, bottom = draw.textbbox(CAPTION_AT, caption, font)
    beside, above = CAPTION_PADDING
    draw.rectangle((left - beside, top - above, right + beside, bottom + above), fill=GROUND)
    draw.text(CAPTION_AT, caption, INK, font)


def _force_curve(take: Take, step: int) -> Image.Image:
    """Tile with the curve of the contact force up to a step; its time axis spans the whole episode."""
    tile = Image.new("RGB", (NARROW, TILE), PAPER)
    draw = ImageDraw.Draw(tile)
    left, top, right, bottom = MARGINS[0], MARGINS[1], NARROW - MARGINS[2], TILE - MARGINS[3]
    largest = max(*take.forces, take.force_limit or 0.0, SMALLEST_AXIS) * HEADROOM
    across = np.linspace(left, right, max(len(take.forces), 2))
    down = bottom - (bottom - top) * np.asarray(take.forces) / largest
    draw.line((left, bottom, right, bottom), FAINT)
    if take.force_limit:
        height = bottom - (bottom - top) * take.force_limit / largest
        draw.line((left, height, right, height), LIMIT)
        gentle = f"gentle: up to {take.force_limit:g} N"
        draw.text((right, height - LIMIT_LIFT), gentle, LIMIT, _font(LIMIT_SIZE), anchor="rs")
    points = list(zip(across.tolist(), down.tolist(), strict=False))[: step + 1]
    if len(points) > 1:
        draw.line(points, CURVE, width=2, joint="curve")
    x, y = points[-1]
    draw.ellipse((x - POINT_RADIUS, y - POINT_RADIUS, x + POINT_RADIUS, y + POINT_RADIUS), fill=CURVE)
    draw.text(CAPTION_AT, f"contact force: {take.forces[step]:.1f} N", INK, _font(CAPTION_SIZE))
    return tile


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
