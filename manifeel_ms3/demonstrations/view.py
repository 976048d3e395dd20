"""Look at a recorded episode in Rerun: `python -m manifeel_ms3.demonstrations.view trajectory.h5`.

Cameras, touch, forces, actions and success over one time axis. Needs the extra `view`.
"""

import logging
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import h5py
import numpy as np
import torch
import tyro

from manifeel_ms3.agents.panda_gelsight import ACTION_AXES
from manifeel_ms3.command_line import run
from manifeel_ms3.sensors.visualisation import force_field_images

from .formats.maniskill_h5 import DemonstrationError, open_trajectories, read_header

log = logging.getLogger(__name__)
STEP = "step"
PORT = 9090
FORCES = ("normal, N", "shear down the pad, N", "shear across the pad, N")  # of a whole pad


@dataclass
class Args:
    file: tyro.conf.Positional[Path]
    episode: int = 0
    save: Path | None = None
    """a .rrd to write, to be opened with `rerun` later; default: open the viewer"""
    web: bool = False
    """open it in the browser, from this machine's port 9090"""


def main(args: Args) -> None:
    """Show an episode, or write it.

    Raises:
        DemonstrationError: the file is missing or broken, or has no such episode.
        ModuleNotFoundError: Rerun is not installed.
    """
    recording = recording_of(args.file, args.episode)
    if args.save:
        recording.save(args.save)
        log.info("%s; `rerun %s` opens it", args.save, args.save)
    elif args.web:
        import rerun as rr  # pyright: ignore[reportMissingImports]

        stream = recording.serve_grpc()
        rr.serve_web_viewer(web_port=PORT, connect_to=stream)
        log.info("http://localhost:%d/?url=%s\nCtrl-C ends it", PORT, quote(stream, safe=""))
        while True:
            time.sleep(1)
    else:
        recording.spawn()


def recording_of(file: Path, episode: int) -> Any:
    """Rerun's stream of everything that a file holds of an episode, and how it is laid out."""
    try:
        import rerun as rr  # pyright: ignore[reportMissingImports]
        import rerun.blueprint as rrb  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("the viewer is Rerun: pip install 'manifeel-ms3[view]'") from error
    header = read_header(file)
    if not 0 <= episode < len(header["episodes"]):
        raise DemonstrationError(f"{file} has episodes 0 to {len(header['episodes']) - 1}; there is no {episode}")
    about = header["episodes"][episode]
    name = f"{header['env_info']['env_id'].rpartition(':')[2]}, seed {about['episode_seed']}"
    recording = rr.RecordingStream("manifeel", recording_id=f"{name}, {file}")
    with open_trajectories(file) as opened:
        group = opened[f"traj_{about['episode_id']}"]
        pictures = dict(_pictures(group))
        series = dict(_series(group, ACTION_AXES[about["control_mode"]]))
    for place, frames in pictures.items():
        for step, frame in enumerate(frames):
            recording.set_time(STEP, sequence=step)
            recording.log(place, rr.Image(frame).compress())
    for place, (names, values) in series.items():
        recording.log(place, rr.SeriesLines(names=names), static=True)
        steps = [rr.TimeColumn(STEP, sequence=np.arange(len(values)))]
        recording.send_columns(place, steps, rr.Scalars.columns(scalars=values))
    plots = rrb.Horizontal(*(rrb.TimeSeriesView(origin=place) for place in series))
    views = rrb.Horizontal(*(rrb.Spatial2DView(origin=place) for place in pictures))
    recording.send_blueprint(rrb.Blueprint(rrb.Vertical(views, plots) if pictures else plots, collapse_panels=True))
    return recording


def _pictures(group: h5py.Group) -> Iterator[tuple[str, np.ndarray]]:
    """By name, uint8 (T + 1, H, W, 3)."""
    for sensor, data in group.get("obs/sensor_data", {}).items():
        if "rgb" in data:
            yield f"pictures/{sensor}", data["rgb"][()]
        if "force_field" in data:
            yield f"pictures/{sensor}_forces", force_field_images(torch.from_numpy(data["force_field"][()])).numpy()


def _series(group: h5py.Group, axes: tuple[str, ...]) -> Iterator[tuple[str, tuple[Any, np.ndarray]]]:
    """By name: names of its lines, and values (T, lines)."""
    yield "contact_force", (["of the held part on the world, N"], group["contact_force"][()][:, None])
    for sensor, data in group.get("obs/sensor_data", {}).items():
        if "force_field" in data:
            yield f"{sensor}_force", (list(FORCES), data["force_field"][()].sum((1, 2)))
    yield "actions", (list(axes), group["actions"][()])
    yield "success", (["success"], group["success"][()][:, None].astype(float))


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
