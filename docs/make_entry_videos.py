"""The videos of the leaderboard's entries that have none: `python -m docs.make_entry_videos` in the repository's root.

A video shows the first episode in which the entry's policy succeeds, or the first of all if it never does. Publishing an
entry's results anew deletes its video (`baselines.studies.publish`).
"""

from pathlib import Path

from manifeel_ms3.evaluation.entries import ABOUT, VIDEO_SUFFIX, VIDEOS, published_checkpoints
from manifeel_ms3.evaluation.result import read_result
from manifeel_ms3.paths import leaderboard_dir
from manifeel_ms3.videos.__main__ import Args
from manifeel_ms3.videos.__main__ import main as make_video

WIDTH = 524
"""Width of the videos, in pixels: half of that of other videos, which keeps those of all entries to a few MB."""
FRAMES, FPS = 40, 5
"""Frames of each video at most, and frames per second: a video lasts at most 8 s."""


def main() -> None:
    """Make the videos."""
    for checkpoint in published_checkpoints(leaderboard_dir()):
        result = checkpoint.parents[1] / f"{checkpoint.name}.json"
        out = video_of(result)
        if not out.is_file():
            out.parent.mkdir(parents=True, exist_ok=True)
            outcomes = [episode["success_once"] for episode in read_result(result)["episodes"]]
            shown = outcomes.index(True) if any(outcomes) else 0
            make_video(Args((result,), out, episode=shown, max_frames=FRAMES, fps=FPS, width=WIDTH))


def video_of(result: Path) -> Path:
    """Path of the video of an entry, given by its result file, such as leaderboard/cpu/PegInsertion/rgb/seed0/00007000.json."""
    submission = next(folder for folder in result.parents if (folder / ABOUT).is_file())
    name = result.parents[1].relative_to(submission)
    return (submission / VIDEOS / name).with_name(f"{name.name}{VIDEO_SUFFIX}")


if __name__ == "__main__":
    main()
