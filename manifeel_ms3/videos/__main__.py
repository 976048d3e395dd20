"""Make a video of recorded or evaluated episodes: `manifeel film trajectory.h5 --out peg.mp4`.

A video shows the scene, the image of a camera, TacRGB (the image of the camera in the finger pad), TacFF (the forces on the
pad; arrows are shear) and the contact force over time, under the names of task, episode and seed:

    manifeel film trajectory.h5 --episode 3 --out peg.mp4
    manifeel film runs/peg/evaluation.json --out evaluated.mp4
    manifeel film peg.h5 nut.h5 --max-frames 40 --width 720 --out both.webp

The episode of a trajectory file is replayed from its actions, and every image is rendered anew, so that the file needs no
observations. A result holds no actions: they are those that its policy takes again, from its checkpoint beside the
result if no other is given.
"""

import logging
import sys
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from manifeel_ms3.arguments import one_of
from manifeel_ms3.command_line import json_object, missing_extras_named, run
from manifeel_ms3.demonstrations.formats.folder_checks import require_revision
from manifeel_ms3.demonstrations.formats.maniskill_h5 import DemonstrationError, group_of, open_trajectories, read_header
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation.policy import Policy, PolicySource
from manifeel_ms3.evaluation.report import evaluated_checkpoint
from manifeel_ms3.evaluation.result import read_result
from manifeel_ms3.evaluation.video import act_again, replayed
from manifeel_ms3.paths import CHECKPOINTS
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.tasks.registry import task_spec
from manifeel_ms3.tasks.visuotactile_env import CONTROL_FREQ, SIDES

from .shots import Shot, Take, View, shot_images, shown_steps, video_env

log = logging.getLogger(__name__)
SMALLEST = dict(max_frames=2, fps=1, width=64)
"""Smallest values of the arguments: a video has a first and a last frame, and captions must be readable (chosen)."""


@dataclass
class Args:
    """Make a video of recorded or evaluated episodes."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    """Paths of trajectory files (.h5), or of results of evaluations (.json); the video shows one episode of each."""
    out: Path = Path("video.mp4")
    """Path of the video, which ends in .mp4, .webp or .gif."""
    episode: int = 0
    """Number of the episode in each file, from 0."""
    camera: str | None = None
    """Camera to show: front, side or wrist; the task's policy camera if not given."""
    pad: str = "right"
    """Finger pad to show: left or right."""
    max_frames: int | None = None
    """Largest number of frames of each episode; every control step is a frame if not given."""
    fps: int = CONTROL_FREQ
    """Frames per second. A video of every control step at 10 runs as fast as the episode did."""
    width: int | None = None
    """Width of the video, in pixels; 1048 if not given."""
    checkpoint: Path | None = None
    """Checkpoint folder of the policy of a result; that of its step, in checkpoints beside the result, if not given."""
    policy: str | None = None
    """Policy of a result, if it is not a checkpoint: a class ("module:Class"), or the address of a server."""
    policy_kwargs: str = "{}"
    """Keyword arguments of --policy, as json."""


@dataclass(frozen=True)
class Source:
    """An episode that is to be filmed."""

    path: Path
    """Path of the trajectory file or of the result."""
    env_id: str
    """Id of the task, without a module."""
    env_kwargs: dict[str, Any]
    """Arguments of `gym.make`."""
    entry: dict[str, Any]
    """The episode's entry in the header of the trajectory file, or in the result."""
    result: dict[str, Any] | None
    """Content of the file if it is a result of an evaluation; None for a trajectory file."""

    @property
    def is_result(self) -> bool:
        """Whether the file is a result of an evaluation, and not a trajectory file."""
        return self.result is not None

    @property
    def seed(self) -> int:
        """Seed of the episode."""
        return self.entry["seed" if self.is_result else "episode_seed"]

    @property
    def length(self) -> int:
        """Number of control steps of the episode."""
        return self.entry["episode_len" if self.is_result else "elapsed_steps"]

    @property
    def success(self) -> bool:
        """Whether the episode succeeded when it was recorded or evaluated."""
        return bool(self.entry["success_once" if self.is_result else "success"])


def main(args: Args) -> Path:
    """Make a video, and return its path.

    Raises:
        InvalidArgumentError: An argument is not allowed, or a file has no such episode.
        DemonstrationError: A trajectory file cannot be used, or its actions no longer have the same outcome.
        ResultError: A result cannot be used.
        CheckpointError: The checkpoint of a result is missing or broken.
        MachineError: This machine has no renderer.
        MissingExtraError: The extra `report`, which encodes videos, is not installed.
        FileWriteError: The video cannot be written.
    """
    with missing_extras_named():
        from .layout import video_frames
        from .video_file import check_video, write_video
    _check(args)
    check_video(args.out, args.fps)
    sources = [read_source(path, args.episode) for path in args.files]
    of_a_policy = {"--checkpoint": args.checkpoint, "--policy": args.policy, "--policy-kwargs": args.policy_kwargs != "{}"}
    given = [flag for flag, value in of_a_policy.items() if value]
    if given and not any(source.is_result for source in sources):
        raise InvalidArgumentError(
            f"{', '.join(given)} without a result of an evaluation: trajectory files hold their own actions; leave it out"
        )
    takes = [_take(source, args) for source in sources]
    write_video(map(video_frames, takes), args.out, args.fps, args.width)
    return args.out


def _check(args: Args) -> None:
    """Check the arguments before anything is rendered.

    Raises:
        InvalidArgumentError: An argument is not allowed.
    """
    if not args.files:
        raise InvalidArgumentError("no file is given; give a trajectory file (.h5) or a result of `manifeel eval` (.json)")
    one_of("--pad", args.pad, SIDES)
    json_object("--policy-kwargs", args.policy_kwargs)
    if args.checkpoint and args.policy:
        raise InvalidArgumentError("give either --checkpoint or --policy, by which a result's episode is acted again")
    for name, least in SMALLEST.items():
        value = getattr(args, name)
        if value is not None and value < least:
            raise InvalidArgumentError(f"--{name.replace('_', '-')} {value} is too small; give {least} or more")


def read_source(path: Path, episode: int) -> Source:
    """Find an episode in a trajectory file, or in a result of an evaluation.

    Raises:
        DemonstrationError: The trajectory file, or its json, is missing or broken, or another revision of the task was run.
        ResultError: The result is missing or broken.
        InvalidArgumentError: There is no such episode.
    """
    recording = path.with_suffix(".h5") if path.suffix == ".json" else path
    is_result = path.suffix == ".json" and not recording.is_file()
    content: dict[str, Any] = read_result(path) if is_result else read_header(recording)
    about = content if is_result else content["env_info"]
    count = len(content["episodes"])
    if not 0 <= episode < count:
        raise InvalidArgumentError(f"--episode {episode}: {path} has the episodes 0 to {count - 1}")
    env_id = task_spec(about["env_id"]).env_id
    require_revision(path, env_id, content.get("revision"))
    entry = content["episodes"][episode]
    return Source(path if is_result else recording, env_id, dict(about["env_kwargs"]), entry, content if is_result else None)


def _take(source: Source, args: Args) -> Take:
    """Run an episode again, and take the shots of its video.

    Raises:
        DemonstrationError: The recorded actions now fail where they succeeded before, or the other way round.
    """
    spec = task_spec(source.env_id)
    one_of("--camera", args.camera, (None, *spec.env_class.known_cameras()))
    view = View(args.camera or spec.policy_camera, args.pad)
    kind = "policy" if source.is_result else "demonstration"
    take = Take(f"{spec.name}, {kind}, seed {source.seed}", spec.force_limit)
    steps = shown_steps(source.length, args.max_frames)
    actions = _actions(source, args)
    with progress_bar() as bar:
        counter = bar.add_task(f"filming {spec.name}", total=source.length + 1)
        with closing(video_env(source.env_id, source.env_kwargs, view)) as env:
            base: Any = env.unwrapped
            take.control_freq = base.control_freq
            for step, (obs, info) in enumerate(replayed(env, actions, source.seed)):
                take.forces.append(float(info["contact_force"]))
                take.successes.append(bool(info["success"]))
                if step in steps:
                    take.shots.append(Shot(step, shot_images(env, obs, view)))
                bar.advance(counter)
    if any(take.successes) != source.success:
        _name_difference(source, any(take.successes))
    return take


def _actions(source: Source, args: Args) -> Iterable[np.ndarray]:
    """The actions (A,) of an episode: those of the trajectory file, or those that the policy of a result takes now."""
    if source.result is not None:
        policy = _policy(source.path, source.result, args)
        return act_again(source.env_id, source.env_kwargs, policy, source.seed)[1]
    with open_trajectories(source.path) as file:
        return group_of(file, source.entry)["actions"][()]


def _policy(path: Path, result: dict[str, Any], args: Args) -> Policy:
    """The policy of a result."""
    if args.policy is not None:
        return PolicySource(policy=args.policy, kwargs=args.policy_kwargs).make()
    expected = args.checkpoint or path.parent / CHECKPOINTS
    if not expected.is_dir():
        raise InvalidArgumentError(
            f"{path} holds no actions, and there is no checkpoint in {expected} whose policy could act again; give its "
            "--checkpoint or --policy"
        )
    checkpoint = args.checkpoint or evaluated_checkpoint(path, result)
    return PolicySource(checkpoint, kwargs=args.policy_kwargs).as_in(result).make()


def _name_difference(source: Source, success: bool) -> None:
    """Report that an episode has another outcome than before.

    Raises:
        DemonstrationError: The episode is of a trajectory file, whose actions alone decide the outcome.
    """
    outcome = "succeeds" if success else "does not succeed"
    if source.is_result:
        log.warning("the episode of seed %d %s now, other than in %s", source.seed, outcome, source.path)
        return
    raise DemonstrationError(
        f"the episode of seed {source.seed} in {source.path} {outcome} now, other than when it was recorded; the json "
        "beside the file names the versions that it was recorded with: use those, or record it again here"
    )


def next_step(_args: Args, made: Path) -> str:
    """Sentence about what the command has made, and what one can do with it."""
    return f"{made} ({made.stat().st_size / 1e6:.1f} MB) plays in any browser"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
