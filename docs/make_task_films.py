"""The films of docs/films and of README, made anew: `python -m docs.make_task_films` in the repository's root.

They show the first episodes of data/sample. With names of tasks as arguments, only the films of these are made.
"""

import hashlib
import json
import sys
from pathlib import Path

from docs.make_task_cards import FILMS, own_tasks
from manifeel_ms3.files import write_json
from manifeel_ms3.films.__main__ import Args
from manifeel_ms3.films.__main__ import main as make_film
from manifeel_ms3.paths import data_dir
from manifeel_ms3.tasks.registry import task_spec

IN_README = ("PegInsertion", "BallSorting", "NutBoltAssembly")
WIDTH = 720
"""Width of the films, in pixels."""
FRAMES, FPS = 60, 8
"""Frames of each film at most, and frames per second: long episodes run faster than they did."""
README_FRAMES = 36
"""Frames of each task in README's film, which must stay below 3 MB."""


SAMPLES = FILMS / "samples.json"
"""The file that says which samples each film shows, by their hashes: a test fails where a sample is another one today."""


def main(names: list[str]) -> None:
    """Make the films."""
    FILMS.mkdir(exist_ok=True)
    for name in names or [spec.name for spec in own_tasks()]:
        _make(FILMS / f"{name}.mp4", (name,), FRAMES)
    if not names:
        _make(Path(__file__).parent / "images/film.webp", IN_README, README_FRAMES)


def _make(out: Path, tasks: tuple[str, ...], frames: int) -> None:
    """Make the film of some tasks, and write down what it shows."""
    make_film(Args(tuple(map(sample_of, tasks)), out, max_frames=frames, fps=FPS, width=WIDTH))
    shown = json.loads(SAMPLES.read_text(encoding="utf-8")) if SAMPLES.is_file() else {}
    write_json(SAMPLES, shown | {out.name: hashes_of(tasks)})


def sample_of(task: str) -> Path:
    """Path of the recording that a task's film shows."""
    return data_dir() / "sample" / task_spec(task).env_id / "trajectory.h5"


def hashes_of(tasks: tuple[str, ...]) -> dict[str, str]:
    """SHA-256 of the recordings of some tasks."""
    return {task: hashlib.sha256(sample_of(task).read_bytes()).hexdigest() for task in tasks}


if __name__ == "__main__":
    main(sys.argv[1:])
