"""Record the full set of demonstrations: `manifeel dataset --num-procs 2`.

Each task has two files with ManiSkill's names: `trajectory.h5` with states and actions alone, and
`trajectory.<obs_mode>.<control_mode>.<sim_backend>.h5` with the same episodes and their observations. A `manifest.json` beside
the tasks' folders has hashes, versions, seeds and outcomes, which `validate` checks. A run that was killed continues where it
stopped when the same command is given again.
"""

import shutil
import sys
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import tyro

from manifeel_ms3.arguments import require_positive, several_of
from manifeel_ms3.command_line import as_typed, run
from manifeel_ms3.errors import InvalidFileError, MachineError
from manifeel_ms3.files import file_hash, read_json, write_json
from manifeel_ms3.ownership import owned
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.rendering.cameras import IMAGE_SIZE
from manifeel_ms3.tasks.obs_modes import has_images, split_obs_mode
from manifeel_ms3.tasks.registry import all_tasks, task_spec
from manifeel_ms3.tasks.visuotactile_env import CAMERAS, SIDES

from . import record, render_observations
from .formats.maniskill_h5 import DemonstrationError, count_episodes, read_header, task_of, versions_of
from .recording import STATES_FILE, trajectory_name

DEMONSTRATIONS_SCHEMA = "manifeel-demonstrations-1"
"""Name and version of the manifest's form."""
MANIFEST_FILE = "manifest.json"
"""Name of the manifest in its folder."""
SMALLEST_SHARE = 0.2
"""Smallest share of a demonstration's full size that is expected where images are fewer or smaller, because force fields and
states do not shrink with them; set once, not tuned."""
MANIFEST = {
    "type": "object",
    "required": ["schema", "files"],
    "properties": {"files": {"type": "object", "additionalProperties": {"type": "object"}}},
}
"""Json schema of the fields that are read from a manifest."""


@dataclass
class Args:
    """Arguments of the command."""

    out: Path = Path("data/demos")
    """Folder to write."""
    tasks: tuple[str, ...] = field(default_factory=lambda: tuple(all_tasks()))
    """Ids or short names of the tasks to record."""
    num: Annotated[int | None, tyro.conf.arg(name="num-demos", aliases=["-n", "--num"])] = None
    """Number of episodes of each task; as many as the paper recorded if not given."""
    workers: Annotated[int, tyro.conf.arg(name="num-procs", aliases=["--workers"])] = 1
    """Number of worker processes."""
    obs_mode: str = "rgb+tacrgb+tacff"
    """Observations to render, joined by "+"; "none" writes states and actions alone."""
    cameras: tuple[str, ...] = CAMERAS
    """Cameras to render."""
    tactile_sensors: tuple[str, ...] = SIDES
    """Sides of the tactile sensors to render."""
    image_size: int | None = None
    """Width and height of camera images in pixels; the tasks' 256 if not given."""


def main(args: Args) -> Path:
    """Record, and return the path of the manifest.

    Raises:
        UnknownNameError: A task is not registered, or has no demonstrator.
        InvalidArgumentError: A number is too small, or an observation, camera or sensor is unknown.
        MachineError: The disk has too little room, or the folder cannot be written.
        InUseError: Another process writes the folder.
    """
    require_positive(num_demos=args.num, num_procs=args.workers, image_size=args.image_size)
    split_obs_mode(args.obs_mode)
    for task in map(task_spec, args.tasks):
        several_of("--cameras", args.cameras, task.env_class.known_cameras())
    several_of("--tactile-sensors", args.tactile_sensors, SIDES)
    with owned(args.out / MANIFEST_FILE):
        return _record_all(args)


def _record_all(args: Args) -> Path:
    counts = {spec.env_id: args.num or spec.paper_demos for spec in map(task_spec, args.tasks)}
    observed = args.obs_mode != "none"
    files = {
        task: (args.out / task / STATES_FILE, args.out / task / trajectory_name(task, dict(obs_mode=args.obs_mode)))
        for task in counts
    }
    if observed:
        _check_room(args, {task: max(0, counts[task] - _num_finished(trajectory)) for task, (_, trajectory) in files.items()})
    described: dict[Path, dict[str, Any]] = {}
    with progress_bar() as bar:
        total = sum(counts.values()) * (2 if observed else 1)
        wanted = [path for paths in files.values() for path in paths[: 1 + observed]]
        done = sum(map(_num_finished, wanted))
        progress = bar.add_task("all tasks", total=total, completed=min(done, total))
        count = partial(bar.advance, progress)
        for task, (states, trajectory) in files.items():
            bar.update(progress, description=f"recording {task}")
            record.main(_states_args(args, task, counts[task], states), count)
            if observed:
                bar.update(progress, description=f"rendering {task}")
                render_observations.main(_render_args(args, counts[task], states, trajectory), count)
            for changed in (states, trajectory):
                described.pop(changed, None)
            write_manifest(args.out, described)
    return args.out / MANIFEST_FILE


def _states_args(args: Args, task: str, num: int, path: Path) -> record.Args:
    """Arguments to record states and actions alone, without a renderer."""
    backend = '{"render_backend": "none"}'
    return record.Args(task, num, args.workers, out=path, obs_mode="none", cameras=(), tactile_sensors=(), env_kwargs=backend)


def _render_args(args: Args, num: int, states: Path, trajectory: Path) -> render_observations.Args:
    """Arguments to render the observations of the first episodes of a file of states and actions."""
    images = (args.obs_mode, args.cameras, args.tactile_sensors, args.image_size)
    return render_observations.Args(states, trajectory, *images, workers=args.workers, num=num)


def _num_finished(path: Path) -> int:
    """Number of episodes that a trajectory file holds already; 0 if there is no file."""
    return count_episodes(path) if path.is_file() else 0


def _check_room(args: Args, counts: dict[str, int]) -> None:
    """Check that the disk has room for the number of demonstrations of each task that are still to be rendered.

    Raises:
        MachineError: The disk has too little room.
    """
    free = shutil.disk_usage(args.out).free
    own, touch = split_obs_mode(args.obs_mode)
    textures = sum(map(has_images, own.replace("rgbd", "rgb+depth").split("+")))
    cameras = len(args.cameras) * ((args.image_size or IMAGE_SIZE) / IMAGE_SIZE) ** 2 * textures
    images = cameras + len(args.tactile_sensors) * ("rgb" in touch)
    share = images / (len(CAMERAS) + len(SIDES))  # all are counted as images of one size
    full = sum(count * task_spec(task).demo_megabytes * 1e6 for task, count in counts.items())
    if (needed := full * max(share, SMALLEST_SHARE)) > free:
        raise MachineError(
            f"{args.out} has {free / 1e9:.1f} GB free, {sum(counts.values())} more episodes take up to {needed / 1e9:.1f} GB; "
            "give another --out, fewer --tasks or --cameras, or --obs-mode none (finished episodes are kept)"
        )


def write_manifest(folder: Path, described: dict[Path, dict[str, Any]] | None = None) -> None:
    """Write `manifest.json` for the trajectory files under a folder.

    Args:
        folder: The folder.
        described: Entries of files that are known already, so that large files are not read again. The others are added to it.
    """
    described = {} if described is None else described
    paths = sorted(folder.glob("*/*.h5"))
    described |= {path: describe(path) for path in paths if path not in described}
    files = {path.relative_to(folder).as_posix(): described[path] for path in paths}
    write_json(folder / MANIFEST_FILE, dict(schema=DEMONSTRATIONS_SCHEMA, version=version("manifeel-ms3"), files=files))


def describe(path: Path) -> dict[str, Any]:
    """A trajectory file's entry in the manifest; what a file of another program does not say is None."""
    header = read_header(path)
    episodes = header["episodes"]
    forces = [episode["peak_contact_force"] for episode in episodes if "peak_contact_force" in episode]
    return dict(
        env_id=task_of(header),
        env_kwargs=header["env_info"]["env_kwargs"],
        versions=versions_of(header),
        revision=header.get("revision"),
        sha256=file_hash(path),
        json_sha256=file_hash(path.with_suffix(".json")),
        bytes=path.stat().st_size,
        seeds=[episode["episode_seed"] for episode in episodes],
        failed_seeds=header.get("failed_seeds", []),
        success=sum(bool(episode["success"]) for episode in episodes),
        mean_steps=round(sum(episode["elapsed_steps"] for episode in episodes) / max(len(episodes), 1), 1),
        peak_contact_force=max(forces, default=0.0) if len(forces) == len(episodes) else None,
    )


def read_manifest(folder: Path) -> dict[str, Any]:
    """The content of a folder's manifest.

    Raises:
        DemonstrationError: There is no manifest, or it has another form or a newer version.
    """
    path = Path(folder) / MANIFEST_FILE
    if not path.is_file():
        raise DemonstrationError(f"{path} does not exist; `manifeel dataset` writes one")
    try:
        manifest = read_json(path, MANIFEST, "a manifest")
    except InvalidFileError as error:
        raise DemonstrationError(str(error)) from error
    if (found := manifest["schema"]) != DEMONSTRATIONS_SCHEMA:
        raise DemonstrationError(
            f"{path} has the schema {found!r}, this version reads {DEMONSTRATIONS_SCHEMA!r}; update manifeel-ms3"
        )
    return manifest


def next_step(args: Args, made: Path) -> str:
    """What the command made, and what one can do with it."""
    check = as_typed("manifeel", "validate", args.out)
    return f"{made} lists the files; {check} checks them, `manifeel summary FILE` describes one"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
