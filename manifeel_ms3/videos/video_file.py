"""Writing of videos: H.264 in mp4, animated WebP, and GIF."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from manifeel_ms3.arguments import require_file
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation.video import encode_mp4
from manifeel_ms3.files import atomic_write

SUFFIXES = (".mp4", ".webp", ".gif")
"""Suffixes of the formats in which videos are written."""
GIF_CLOCK = 100
"""Units of time in a second of a GIF."""
BLOCK = 2
"""Widths and heights are cut to multiples of this number of pixels, which H.264 needs."""
WEBP_QUALITY = 70
"""Quality of the WebP encoding from 0 to 100 (chosen by eye: captions stay sharp)."""
WEBP_EFFORT = 4
"""Effort of the WebP encoding, from 0 (fast) to 6 (smallest file); chosen."""
END_SECONDS = 1.5
"""Time for which the last frame of each episode is shown, in s (chosen)."""


def check_video(path: Path, fps: int) -> None:
    """Check that a path ends in a known suffix and can be written, and that its format has the number of frames per second.

    Raises:
        InvalidArgumentError: The path has another suffix, or is a folder, or no file can be made there, or the frames of a GIF
            would not last a whole number, of two or more, of hundredths of a second.
    """
    require_file("--out", path, "episode.mp4")
    if path.suffix.lower() not in SUFFIXES:
        raise InvalidArgumentError(f"--out {path} is not a path of a video; give a file that ends in {', '.join(SUFFIXES)}")
    if path.suffix.lower() == ".gif" and (GIF_CLOCK % fps or fps > GIF_CLOCK // 2):
        rates = [rate for rate in range(1, GIF_CLOCK // 2 + 1) if GIF_CLOCK % rate == 0]
        raise InvalidArgumentError(f"--fps {fps} is not possible in a GIF, which has {rates}; or write a .webp or .mp4")


def write_video(episodes: Iterable[Iterable[Image.Image]], path: Path, fps: int, width: int | None = None) -> None:
    """Write the frames of some episodes, one after the other, as one video that stops for a moment after each episode.

    A frame is only taken when it is written, so that a long video needs no memory for all of them.

    Args:
        episodes: Frames of each episode, of which there is at least one.
        path: Path of the video; its suffix decides the format.
        fps: Frames per second.
        width: Width of the video in pixels; that of the frames if not given.

    Raises:
        FileWriteError: The video cannot be written.
    """
    frames = (_resized(frame, width) for episode in episodes for frame in _with_end(episode, round(END_SECONDS * fps)))
    with atomic_write(path) as partial:
        if path.suffix.lower() == ".mp4":
            partial.write_bytes(encode_mp4(map(np.asarray, frames), fps, BLOCK))
        else:
            _write_animation(frames, partial, path.suffix.lower()[1:].upper(), fps)


def _with_end(episode: Iterable[Image.Image], repeats: int) -> Iterator[Image.Image]:
    """The frames of an episode, the last one several times more."""
    last: Any = None
    for last in episode:
        yield last
    yield from [last] * repeats


def _resized(frame: Image.Image, width: int | None) -> Image.Image:
    width = width or frame.width
    height = round(frame.height * width / frame.width)
    return frame.resize((width // BLOCK * BLOCK, height // BLOCK * BLOCK), Image.Resampling.LANCZOS)


def _write_animation(frames: Iterator[Image.Image], path: Path, kind: str, fps: int) -> None:
    options: dict[str, Any] = dict(quality=WEBP_QUALITY, method=WEBP_EFFORT) if kind == "WEBP" else {}
    next(frames).save(path, kind, save_all=True, append_images=frames, duration=round(1000 / fps), loop=0, **options)
