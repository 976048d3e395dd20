"""Record the full set of demonstrations: `python -m manifeel_ms3.demonstrations.dataset --workers 2`.

For each task two files: `states.h5`, states and actions alone, and `trajectory.h5`, the same episodes with observations; beside
them all a `manifest.json` with hashes, versions, seeds and outcomes, which `validate` checks. A run that was killed goes on
where it stopped when the same command is given again.
"""

import hashlib
import shutil
import sys
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import tyro

from manifeel_ms3.command_line import run
from manifeel_ms3.errors import MachineError
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.tasks.registry import all_tasks, task_spec
from manifeel_ms3.tasks.visuotactile_env import CAMERAS, SIDES

from . import record, render_observations
from .formats.maniskill_h5 import DemonstrationError, finished_episodes, read_header, read_json, write_json

SCHEMA = "manifeel-demonstrations-1"
MANIFEST = {  # what is read of a manifest, as a json schema
    "type": "object",
    "required": ["schema", "files"],
    "properties": {"files": {"type": "object", "additionalProperties": {"type": "object"}}},
}


@dataclass
class Args:
    out: Path = Path("data/demos")
    """folder to write"""
    tasks: tuple[str, ...] = field(default_factory=lambda: tuple(all_tasks()))
    """tasks to record"""
    num: int | None = None
    """episodes a task; default: the paper's counts"""
    workers: int = 1
    """processes"""
    obs_mode: str = "rgb+tacrgb+tacff"
    """what to observe; "none" for states and actions alone"""
    cameras: tuple[str, ...] = CAMERAS
    """cameras to observe"""
    tactile_sensors: tuple[str, ...] = SIDES
    """pads to observe"""
    picture_size: int | None = None
    """pixels, of the cameras' sides; default: the tasks' 256"""


def main(args: Args) -> Path:
    """Record, and return the manifest's path.

    Raises:
        ValueError: a task that is not known.
        MachineError: the disk has no room for it.
    """
    counts = {task: args.num or task_spec(task).paper_demos for task in args.tasks}
    observed = args.obs_mode != "none"
    args.out.mkdir(parents=True, exist_ok=True)
    _check_room(args, counts if observed else {})
    files = {task: (args.out / task / "states.h5", args.out / task / "trajectory.h5") for task in counts}
    with progress_bar() as bar:
        total = sum(counts.values()) * (2 if observed else 1)
        done = sum(len(finished_episodes(path)) for paths in files.values() for path in paths[: 1 + observed])
        whole = bar.add_task("all tasks", total=total, completed=min(done, total))

        def count() -> None:
            bar.advance(whole)

        for task, (states, trajectory) in files.items():
            bar.update(whole, description=f"recording {task}")
            bare = dict(obs_mode="none", cameras=(), tactile_sensors=(), env_kwargs='{"render_backend": "none"}')
            record.main(record.Args(task, counts[task], args.workers, out=states, **bare), count)
            if observed:
                bar.update(whole, description=f"observing {task}")
                pictures = (args.obs_mode, args.cameras, args.tactile_sensors, args.picture_size)
                render_observations.main(render_observations.Args(states, trajectory, *pictures, workers=args.workers), count)
            write_manifest(args.out)
    return args.out / "manifest.json"


def _check_room(args: Args, counts: dict[str, int]) -> None:
    free = shutil.disk_usage(args.out).free
    pixels = ((args.picture_size or 256) / 256) ** 2
    whole = sum(count * task_spec(task).demo_megabytes * 1e6 for task, count in counts.items())
    if (needed := whole * max(pixels, 0.2)) > free:
        raise MachineError(
            f"{args.out} has {free / 1e9:.1f} GB free, {sum(counts.values())} episodes take up to {needed / 1e9:.1f}; give "
            "another --out, fewer --tasks or cameras, or --obs-mode none (what is there already is kept)"
        )


def write_manifest(folder: Path) -> None:
    """Write `manifest.json` for the trajectory files under a folder."""
    files = {path.relative_to(folder).as_posix(): describe(path) for path in sorted(folder.glob("*/*.h5"))}
    write_json(folder / "manifest.json", dict(schema=SCHEMA, version=version("manifeel-ms3"), files=files))


def describe(path: Path) -> dict[str, Any]:
    """What a manifest says of a trajectory file."""
    header = read_header(path)
    episodes = header["episodes"]
    return dict(
        env_id=header["env_info"]["env_id"].rpartition(":")[2],
        env_kwargs=header["env_info"]["env_kwargs"],
        versions=header["versions"],
        sha256=_sha256(path),
        json_sha256=_sha256(path.with_suffix(".json")),
        bytes=path.stat().st_size,
        seeds=[episode["episode_seed"] for episode in episodes],
        failed_seeds=header.get("failed_seeds", []),
        success=sum(bool(episode["success"]) for episode in episodes),
        mean_steps=round(sum(episode["elapsed_steps"] for episode in episodes) / max(len(episodes), 1), 1),
        peak_contact_force=max((episode["peak_contact_force"] for episode in episodes), default=0.0),
    )


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def read_manifest(folder: Path) -> dict[str, Any]:
    """A folder's manifest.

    Raises:
        DemonstrationError: there is none, it is of another form, or of a newer version.
    """
    path = Path(folder) / "manifest.json"
    if not path.is_file():
        raise DemonstrationError(f"{path} does not exist; `python -m manifeel_ms3.demonstrations.dataset` writes one")
    manifest = read_json(path, MANIFEST, "a manifest")
    if (found := manifest["schema"]) != SCHEMA:
        raise DemonstrationError(f"{path} has the schema {found!r}, this version reads {SCHEMA!r}; update manifeel-ms3")
    return manifest


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
