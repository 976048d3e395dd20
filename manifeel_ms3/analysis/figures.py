"""Files of the figures that the analysis draws."""

from pathlib import Path
from typing import Any

from manifeel_ms3.files import atomic_write


def save_figure(figure: Any, path: Path, dpi: int) -> None:
    """Write a figure of matplotlib as a whole.

    Args:
        figure: The figure.
        path: Path of the file; its suffix names the format.
        dpi: Number of pixels per inch.

    Raises:
        FileWriteError: The file cannot be written.
    """
    with atomic_write(path) as partial:
        figure.savefig(partial, dpi=dpi, format=path.suffix.removeprefix("."))
