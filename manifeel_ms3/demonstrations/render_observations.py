"""Add observations to episodes: `manifeel render-observations states.h5 --out observed.h5`.

A file of states and actions is small, and is the form in which demonstrations are shared. Its episodes are replayed from seed
and actions. On the machine that recorded them they are the same bit for bit, and so are the images of cameras and tactile
sensors. Another processor or another version rounds differently, so that contacts come out slightly differently there: the
written file then holds the states of the replay, from which its observations were made, and the json says by how much they
differ from the recorded ones (`replay_deviation`). An episode that no longer succeeds is left out. A run that was killed
continues where it stopped.

With `--control-mode` the actions are also converted to another controller.
"""

import hashlib
import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from manifeel_ms3.arguments import by_name, require_positive
from manifeel_ms3.command_line import run
from manifeel_ms3.errors import InvalidArgumentError, WorkFailedError
from manifeel_ms3.progress import episode_counter
from manifeel_ms3.tasks.visuotactile_env import CAMERAS, SIDES
from manifeel_ms3.workers import WorkerPool

from .convert_actions import converted
from .episode import run_episode
from .formats.folder_checks import require_revision
from .formats.maniskill_h5 import (
    DemonstrationError,
    actions_of,
    first_episodes,
    group_of,
    open_trajectories,
    read_header,
    task_of,
)
from .recording import Recorder, Recording, make_header, make_recorder, next_step, open_recording
from .replay import pose_difference, without_images

log = logging.getLogger(__name__)
RECORDED = "recorded_actions_sha256"
"""Field of an episode's json: hash of the recorded actions of which it is the replay."""
DEVIATION = "replay_deviation"
"""Field of an episode's json, if its replay differs: largest difference of a pose from the recorded one at the same step."""


@dataclass
class Args:
    """Arguments of the command."""

    path: tyro.conf.Positional[Path]
    """Path of the trajectory file that holds states and actions."""
    out: Path
    """Path of the trajectory file to write."""
    obs_mode: str = "rgb+tacrgb+tacff"
    """Observations to render, joined by "+"."""
    cameras: tuple[str, ...] = CAMERAS
    """Cameras to render."""
    tactile_sensors: tuple[str, ...] = SIDES
    """Sides of the tactile sensors to render."""
    image_size: int | None = None
    """Width and height of camera images in pixels; those of the recording, 256 by default, if not given."""
    control_mode: str | None = None
    """Controller to which the actions are converted, such as pd_joint_pos; that of the recording if not given."""
    workers: Annotated[int, tyro.conf.arg(name="num-procs", aliases=["--workers"])] = 1
    """Number of worker processes."""
    num: Annotated[int | None, tyro.conf.arg(name="num-demos", aliases=["-n", "--num"])] = None
    """Number of episodes to render; all of them if not given."""


def main(args: Args, on_episode: Callable[[], None] | None = None) -> Path:
    """Render, and return the path of the trajectory file that was written.

    Args:
        args: Arguments of the command.
        on_episode: Function that is called after each episode; a progress bar is shown if it is not given.

    Raises:
        InvalidArgumentError: The file to write is the file to read, or an argument is not allowed.
        DemonstrationError: A trajectory file is missing or broken, was recorded with other arguments or with another revision
            of the task, or holds a seed twice.
        InUseError: Another process writes the file.
        WorkFailedError: A worker process died, or no episode succeeds in the replay.
    """
    require_positive(num_demos=args.num, num_procs=args.workers, image_size=args.image_size)
    source = read_header(args.path)
    if args.path.resolve() == args.out.resolve():
        raise InvalidArgumentError(f"--out {args.out} is the file that is read; give another")
    require_revision(args.path, env_id := task_of(source), source.get("revision"))
    env_kwargs = _env_kwargs(args, source)
    header = make_header(env_id, env_kwargs) | _origin(source) | dict(failed_seeds=[])
    source_kwargs = None
    if args.control_mode is not None:
        source_kwargs = without_images(source["env_info"]["env_kwargs"])
    episodes = _by_seed(args.path, first_episodes(args.path, source, args.num))
    recorded = _recorded(args.path, episodes)
    with open_recording(args.out, header, list(episodes)) as recording:
        _require_same_actions(recording, args.path, recorded)
        left = [seed for seed in episodes if seed not in recording.infos and seed not in recording.failed]
        if recording.is_complete and not left:
            log.info("%s already holds %d episodes", args.out, len(recording.infos))
            return args.out
        recording.begin()
        with (
            episode_counter(f"rendering {env_id}", len(episodes), len(recording.infos), on_episode) as count,
            WorkerPool(args.workers, partial(make_recorder, env_id, env_kwargs, recording.drafts, source_kwargs)) as pool,
        ):
            for seed in left:
                if seed in recording.kept:
                    count(recording.accept_kept(seed))
                else:
                    pool.submit(partial(_render_episode, recorded=recorded[seed]), episodes[seed])
            for finished in pool.as_finished():
                seed, info = finished.task["episode_seed"], finished.result()
                count(recording.reject(seed) if info is None else recording.accept(seed, info))
        _warn(recording)
        recording.finish()
        if not recording.infos:
            advice = "use the versions that its json names, or record demonstrations of your own"
            if args.control_mode is not None:
                advice = f"{args.control_mode} may be unable to do what they do, such as opening the hand; or {advice}"
            raise WorkFailedError(f"none of the {len(episodes)} episodes of {args.path} succeeds in this replay: {advice}")
    return args.out


def _by_seed(path: Path, episodes: list[dict[str, Any]]) -> dict[int, dict[str, Any]]:
    """The entries of a file's episodes by their seeds, which name the episodes of the file that is written.

    Raises:
        DemonstrationError: Two episodes have one seed.
    """
    found = {episode["episode_seed"]: episode for episode in episodes}
    if len(found) < len(episodes):
        raise DemonstrationError(
            f"{path} holds {len(episodes)} episodes of {len(found)} seeds, and the written file would have one of each seed; "
            "render the files that it was merged from"
        )
    return found


def _origin(source: dict[str, Any]) -> dict[str, Any]:
    """Who acted in the recorded episodes, and with which versions, as far as a header or an episode's entry says it."""
    kept = {name: source[name] for name in ("source_type", "source_desc") if name in source}
    return kept | ({"recorded_with": source["versions"]} if "versions" in source else {})


def _warn(recording: Recording) -> None:
    """Say which episodes came out differently than they were recorded."""
    if recording.failed:
        log.warning("the episodes of the seeds %s do not succeed in this replay and are left out", sorted(recording.failed))
    deviations = [info[DEVIATION] for info in recording.infos.values() if DEVIATION in info]
    if deviations:
        log.warning(
            "%d of %d episodes succeed, but not bit for bit as they were recorded (poses differ by up to %.1g, in m or in a "
            "quaternion's components): another processor or version rounds differently. %s holds the states of this replay",
            *(len(deviations), len(recording.infos), max(deviations), recording.path),
        )


def _env_kwargs(args: Args, source: dict[str, Any]) -> dict[str, Any]:
    """Arguments of the environment that renders: those of the recording, with the changes that the arguments ask for."""
    sensing = dict(obs_mode=args.obs_mode, cameras=list(args.cameras), tactile_sensors=list(args.tactile_sensors))
    asked: dict[str, Any] = {} if args.control_mode is None else dict(control_mode=args.control_mode)
    recorded = source["env_info"]["env_kwargs"]
    if args.image_size is not None:
        asked["sensor_configs"] = _resized(recorded.get("sensor_configs") or {}, args.image_size, args.cameras)
    without_renderer = "render_backend" if recorded.get("render_backend") == "none" else None
    return {name: value for name, value in recorded.items() if name != without_renderer} | sensing | asked


def _resized(configs: Any, size: int, cameras: tuple[str, ...]) -> dict[str, Any]:
    """ManiSkill's `sensor_configs` with another width and height of all cameras' images.

    Raises:
        InvalidArgumentError: The given `sensor_configs` are not a dict.
    """
    shape = dict(width=size, height=size)
    given = dict(by_name("sensor_configs", configs, "dict(wrist=dict(width=128))"))
    own = {camera: given[camera] | shape for camera in cameras if isinstance(given.get(camera), dict)}
    return given | shape | own


@dataclass(frozen=True)
class _Recorded:
    """What a file holds of an episode that is rendered."""

    path: Path
    """Path of the file."""
    actions: np.ndarray
    """Actions (T, A)."""
    actors: dict[str, np.ndarray]
    """States (T + 1, 13) by actor."""

    @property
    def sha256(self) -> str:
        """Hash of the actions, which together with the seed decide what is rendered."""
        return hashlib.sha256(self.actions.tobytes()).hexdigest()


def _recorded(path: Path, episodes: dict[int, dict[str, Any]]) -> dict[int, _Recorded]:
    """Actions and states of all episodes by seed, given the entries of the episodes in the json."""
    recorded = {}
    with open_trajectories(path) as file:
        for seed, episode in episodes.items():
            actors = group_of(file, episode).get("env_states/actors", {})
            states = {name: values[()] for name, values in actors.items()}
            recorded[seed] = _Recorded(path, actions_of(file, episode), states)
    return recorded


def _require_same_actions(recording: Recording, path: Path, recorded: dict[int, _Recorded]) -> None:
    """Check that the episodes that were rendered earlier are those of the file that is rendered now.

    Raises:
        DemonstrationError: An episode was rendered from other actions. Episodes of earlier versions do not say from which.
    """
    rendered = {seed: info[RECORDED] for seed, info in (recording.infos | recording.kept).items() if RECORDED in info}
    if other := [seed for seed in rendered.keys() & recorded.keys() if rendered[seed] != recorded[seed].sha256]:
        raise DemonstrationError(
            f"{recording.path} holds the seeds {sorted(other)} with other actions than {path} has now; give another --out, or "
            "delete the file to render all episodes anew"
        )


def _render_episode(recorder: Recorder, entry: dict[str, Any], recorded: _Recorded) -> dict[str, Any] | None:
    """In a worker process: replay an episode with observations, and return its entry in the json.

    Args:
        recorder: State of the process.
        entry: The recorded episode's entry in its json.
        recorded: What its file holds of it.

    Returns:
        None if the recording succeeds and the replay does not.
    """
    seed, source, actions = entry["episode_seed"], recorder.source, recorded.actions
    episode = run_episode(
        recorder.env, seed, lambda: actions if source is None else converted(actions, seed, source, recorder.env)
    )
    if episode.info["success"] < entry["success"]:
        return None
    if source is None:
        deviation = _deviation(recorded, episode.arrays["env_states"]["actors"])
        if deviation or len(actions) != episode.info["elapsed_steps"]:
            episode.info[DEVIATION] = deviation
    episode.info |= _origin(entry) | {RECORDED: recorded.sha256}
    return recorder.write(episode)


def _deviation(recorded: _Recorded, replayed: dict[str, np.ndarray]) -> float:
    """Largest difference of any actor's pose at any step that both have, in m or in a quaternion's components.

    Args:
        recorded: What the file holds of the episode.
        replayed: The states of the replay by actor, of fewer steps if it ended earlier.

    Raises:
        DemonstrationError: The recording has states of other actors, or not after every action.
    """
    differences = [0.0]
    for name, states in replayed.items():
        before = recorded.actors.get(name)
        if before is None or before.shape != (len(recorded.actions) + 1, *states.shape[1:]):
            raise DemonstrationError(f"{recorded.path} has no states of {name} at every step; record it again")
        differences.append(pose_difference(before[: len(states)], states))
    return max(differences)


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
