"""The films of docs/films and of README, made anew: `python -m docs.make_task_films` in the repository's root.

They show the first episodes of data/sample. With names of tasks as arguments, only the films of these are made.
"""

import sys
from pathlib import Path

from docs.make_task_cards import FILMS, own_tasks
from manifeel_ms3.films.__main__ import Args
from manifeel_ms3.films.__main__ import main as make_film
from manifeel_ms3.paths import data_dir

IN_README = ("PegInsertion", "BallSorting", "NutBoltAssembly")
WIDTH = 720
"""Width of the films, in pixels."""
FRAMES, FPS = 60, 8
"""Frames of each film at most, and frames per second: long episodes run faster than they did."""
README_FRAMES = 36
"""Frames of each task in README's film, which must stay below 3 MB."""


def main(names: list[str]) -> None:
    """Make the films."""
    samples = {spec.name: data_dir() / "sample" / spec.env_id / "trajectory.h5" for spec in own_tasks()}
    FILMS.mkdir(exist_ok=True)
    for name in names or samples:
        make_film(Args((samples[name],), FILMS / f"{name}.mp4", max_frames=FRAMES, fps=FPS, width=WIDTH))
    if not names:
        out = Path(__file__).parent / "images/film.webp"
        make_film(Args(tuple(samples[name] for name in IN_README), out, max_frames=README_FRAMES, fps=FPS, width=WIDTH))


if __name__ == "__main__":
    main(sys.argv[1:])
