"""View a recorded episode in Rerun: `manifeel view peg.h5`.

Cameras, touch, forces, actions and success are shown over one time axis. Needs the extra `view`.
"""

import logging
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import tyro

from manifeel_ms3.agents.panda_gelsight import ACTION_AXES, JOINT_ACTION_AXES
from manifeel_ms3.arguments import require_file
from manifeel_ms3.command_line import missing_extras_named, run
from manifeel_ms3.errors import InvalidArgumentError, MachineError
from manifeel_ms3.files import atomic_write
from manifeel_ms3.network import LOOPBACK
from manifeel_ms3.sensors.config import TactileSensorConfig
from manifeel_ms3.sensors.visualisation import force_field_images

from .formats.maniskill_h5 import DemonstrationError, first_episodes, group_of, open_trajectories, read_header, task_of
from .formats.touch_units import SUMS, recorded_sensor

log = logging.getLogger(__name__)
TIMELINE = "step"
"""Name of Rerun's time axis, which counts control steps."""


@dataclass
class Args:
    """Arguments of the command."""

    file: tyro.conf.Positional[Path]
    """Path of the trajectory file."""
    episode: int = 0
    """Number of the episode, from 0."""
    save: Path | None = None
    """Path of a .rrd file to write, which `rerun` opens; the viewer is opened if not given."""
    web: bool = False
    """Whether the viewer is served for a browser, which must run on this machine."""
    port: int = 9090
    """Port of the viewer in the browser."""


@dataclass(frozen=True)
class EpisodeStreams:
    """Everything that the viewer shows of an episode, by its path in Rerun's tree."""

    title: str
    """Name of the task, and seed of the episode."""
    images: dict[str, np.ndarray]
    """Images uint8 (T + 1, H, W, 3) by path."""
    series: dict[str, tuple[list[str], np.ndarray]]
    """Names of lines, and their values (T or T + 1, lines), by path."""


def main(args: Args) -> None:
    """Show an episode, or write it to a file.

    Raises:
        DemonstrationError: The file is missing or broken, or has no such episode.
        InvalidArgumentError: The path to write is that of a folder, or a browser is asked for as well.
        MachineError: The viewer does not start, for example because there is no screen.
        MissingExtraError: Rerun is not installed.
    """
    if args.save and args.web:
        raise InvalidArgumentError(
            f"--save {args.save} writes a file, and --web shows the episode in a browser; give one of them"
        )
    if args.save:
        require_file("--save", args.save, "episode.rrd")
    recording = rerun_recording(args.file, args.episode)
    if args.save:
        with atomic_write(args.save) as partial:
            recording.save(partial)
            recording.disconnect()
        log.info("%s; `rerun %s` opens it", args.save, args.save)
        return
    with TemporaryDirectory(prefix="manifeel-view-") as folder:
        file = Path(folder) / "episode.rrd"
        recording.save(file)
        recording.disconnect()
        _show(viewer_command(file, args.port if args.web else None), without_statistics(Path(folder)))


def viewer_command(file: Path, web_port: int | None) -> list[str]:
    """Command that shows a .rrd file in Rerun's viewer and listens on the loopback address only.

    By default, Rerun would listen on every address of the machine, without a password.

    Args:
        file: Path of the .rrd file.
        web_port: Port at which the viewer is served for a browser; None for the viewer in a window of its own.

    Raises:
        MachineError: The installed Rerun has no viewer.
    """
    command = [_viewer(), str(file), "--bind", LOOPBACK, "--port", str(_free_port())]
    return command if web_port is None else [*command, "--serve-web", "--web-viewer-port", str(web_port)]


def _viewer() -> str:
    """Path of Rerun's program.

    Raises:
        MachineError: The installed Rerun has none.
    """
    import rerun_cli

    if (program := shutil.which("rerun", path=Path(rerun_cli.__file__).parent)) is None:
        raise MachineError("the installed rerun-sdk has no viewer; use --save, and open the file elsewhere")
    return program


def _free_port() -> int:
    """Number of a free port; on Rerun's default port, another user's viewer could listen and receive the episode."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


def without_statistics(folder: Path) -> dict[str, str]:
    """Environment variables with which Rerun does not send usage statistics, which it otherwise does.

    Args:
        folder: A folder for Rerun's settings, which no other process writes.
    """
    environment = os.environ | dict(XDG_CONFIG_HOME=str(folder))
    subprocess.run([_viewer(), "analytics", "disable"], env=environment, capture_output=True, check=False)
    return environment


def _show(command: list[str], environment: dict[str, str]) -> None:
    """Run the viewer until it is closed or this process is interrupted; then the viewer ends, too."""
    with subprocess.Popen(command, env=environment) as viewer:
        try:
            if viewer.wait() != 0:
                raise MachineError(
                    f"Rerun's viewer ended with exit code {viewer.returncode}; use --web or --save without a screen"
                )
        finally:
            viewer.kill()  # the viewer has nothing to save
            viewer.wait()


def rerun_recording(file: Path, episode: int) -> Any:
    """Rerun's recording of everything that a file holds of an episode, with the layout of the viewer.

    Raises:
        DemonstrationError: The file is missing or broken, or has no such episode.
        MissingExtraError: Rerun is not installed.
    """
    with missing_extras_named():
        import rerun as rr
    streams = read_streams(file, episode)
    recording = rr.RecordingStream("manifeel", recording_id=f"{streams.title}, {file}")
    for place, frames in streams.images.items():
        for step, frame in enumerate(frames):
            recording.set_time(TIMELINE, sequence=step)
            recording.log(place, rr.Image(frame).compress())
    for place, (names, values) in streams.series.items():
        recording.log(place, rr.SeriesLines(names=names), static=True)
        steps = [rr.TimeColumn(TIMELINE, sequence=np.arange(len(values)))]
        recording.send_columns(place, steps, rr.Scalars.columns(scalars=values))
    recording.send_blueprint(_blueprint(streams))
    return recording


def read_streams(file: Path, episode: int) -> EpisodeStreams:
    """Read everything that is shown of an episode.

    Raises:
        DemonstrationError: The file is missing or broken, or has no such episode.
        ManifeelError: The sensor is of a package that is not installed, or the arguments of the pads are not allowed.
    """
    header = read_header(file)
    episodes = first_episodes(file, header, None)
    if not 0 <= episode < len(episodes):
        raise DemonstrationError(f"{file} has episodes 0 to {len(episodes) - 1}; there is no {episode}")
    entry = episodes[episode]
    title = f"{task_of(header)}, seed {entry['episode_seed']}"
    with open_trajectories(file) as opened:
        group = group_of(opened, entry)
        touched = [name for name, data in group.get("obs/sensor_data", {}).items() if "force_field" in data]
        sensors = {pad: recorded_sensor(header["env_info"]["env_kwargs"], pad) for pad in touched}
        names = action_names(entry.get("control_mode", ""), group["actions"].shape[1])
        return EpisodeStreams(title, dict(_images(group, sensors)), dict(_series(group, sensors, names)))


def action_names(control_mode: str, size: int) -> list[str]:
    """Names of the entries of an action; numbers where the control mode, or its number of entries, is another robot's.

    Args:
        control_mode: Name of the controller, such as "pd_ee_delta_pose".
        size: Number of entries.
    """
    names = list((ACTION_AXES | JOINT_ACTION_AXES).get(control_mode, ()))
    return names if len(names) == size else list(map(str, range(size)))


def _blueprint(streams: EpisodeStreams) -> Any:
    """Layout of the viewer: images above, plots below."""
    import rerun.blueprint as rrb

    plots = rrb.Horizontal(*(rrb.TimeSeriesView(origin=place) for place in streams.series))
    views = rrb.Horizontal(*(rrb.Spatial2DView(origin=place) for place in streams.images))
    return rrb.Blueprint(rrb.Vertical(views, plots) if streams.images else plots, collapse_panels=True)


def _images(group: Any, sensors: dict[str, TactileSensorConfig]) -> Iterator[tuple[str, np.ndarray]]:
    """Images of an episode's cameras and tactile sensors, by place; force fields are drawn."""
    for sensor, data in group.get("obs/sensor_data", {}).items():
        if "rgb" in data:
            yield f"images/{sensor}", data["rgb"][()]
        if "force_field" in data:
            fields, full_scale = torch.from_numpy(data["force_field"][()]), sensors[sensor].full_scale
            yield f"images/{sensor}_forces", force_field_images(fields, full_scale).numpy()


def _series(
    group: Any, sensors: dict[str, TactileSensorConfig], action_names: list[str]
) -> Iterator[tuple[str, tuple[list[str], np.ndarray]]]:
    """Numbers over time of an episode, by place."""
    if "contact_force" in group:  # files of other programs hold no forces
        yield "contact_force", (["of the hand on the held part, N"], group["contact_force"][()][:, None])
    for pad, sensor in sensors.items():
        field = group[f"obs/sensor_data/{pad}/force_field"][()]
        yield f"{pad}_force", (list(SUMS[sensor.units]), field.sum((1, 2)))
    yield "actions", (action_names, group["actions"][()])
    yield "success", (["success"], group["success"][()][:, None].astype(float))


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
