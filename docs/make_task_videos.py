"""The videos of docs/videos and of README, made anew: `python -m docs.make_task_videos` in the repository's root.

They show the first episodes of data/sample. With names of tasks as arguments, only the videos of these are made.
"""

import json
import sys
from pathlib import Path

from docs.make_task_cards import VIDEOS, own_tasks
from manifeel_ms3.files import file_hash, write_json
from manifeel_ms3.paths import data_dir
from manifeel_ms3.tasks.registry import task_spec
from manifeel_ms3.videos.__main__ import Args
from manifeel_ms3.videos.__main__ import main as make_video

IN_README = ("PegInsertion", "BallSorting", "NutBoltAssembly")
WIDTH = 720
"""Width of the videos, in pixels."""
FRAMES, FPS = 60, 8
"""Frames of each video at most, and frames per second: long episodes run faster than they did."""
README_FRAMES = 36
"""Frames of each task in README's video, which must stay below 3 MB."""


SAMPLES = VIDEOS / "samples.json"
"""The file that says which samples each video shows, by their hashes: a test fails where a sample is another one today."""


def main(names: list[str]) -> None:
    """Make the videos."""
    VIDEOS.mkdir(exist_ok=True)
    for name in names or [spec.name for spec in own_tasks()]:
        _make(VIDEOS / f"{name}.mp4", (name,), FRAMES)
    if not names:
        _make(Path(__file__).parent / "images/demonstrations.webp", IN_README, README_FRAMES)


def _make(out: Path, tasks: tuple[str, ...], frames: int) -> None:
    """Make the video of some tasks, and write down what it shows."""
    make_video(Args(tuple(map(sample_of, tasks)), out, max_frames=frames, fps=FPS, width=WIDTH))
    shown = json.loads(SAMPLES.read_text(encoding="utf-8")) if SAMPLES.is_file() else {}
    write_json(SAMPLES, shown | {out.name: hashes_of(tasks)})


def sample_of(task: str) -> Path:
    """Path of the recording that a task's video shows."""
    return data_dir() / "sample" / task_spec(task).env_id / "trajectory.h5"


def hashes_of(tasks: tuple[str, ...]) -> dict[str, str]:
    """SHA-256 of the recordings of some tasks."""
    return {task: file_hash(sample_of(task)) for task in tasks}


if __name__ == "__main__":
    main(sys.argv[1:])
