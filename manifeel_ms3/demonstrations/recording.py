"""Common parts of all commands that record: a trajectory file to which episodes are added, its json, the state of a worker."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import gymnasium as gym

from manifeel_ms3.arguments import names_in
from manifeel_ms3.command_line import as_typed
from manifeel_ms3.errors import InvalidArgumentError, InvalidFileError
from manifeel_ms3.files import FileWriteError, move, read_json, remove_folder, write_json
from manifeel_ms3.nested_settings import differing
from manifeel_ms3.ownership import owned
from manifeel_ms3.provenance import git_commit, package_versions
from manifeel_ms3.tasks.obs_modes import TACTILE_TOKENS, split_obs_mode
from manifeel_ms3.tasks.registry import FIRST_EVALUATION_SEED, make_env, task_spec

from .formats.maniskill_h5 import HEADER, ORIGIN, DemonstrationError, read_header, task_of
from .formats.maniskill_h5_writing import (
    RecordedEpisode,
    consolidate,
    episode_file,
    episode_folder,
    finished_episodes,
    indexed_seeds,
    is_index,
    remove_recording,
    separate,
    write_episode,
    write_index,
)

STATES_FILE = "trajectory.h5"
"""Name of a file of states and actions, without observations, as ManiSkill's users expect."""
SESSION = "session-"
"""First part of the name of the folder into which the workers of one recording session write."""


def require_demonstration_seeds(first: int, count: int, asked: str) -> None:
    """Check that seeds are for demonstrations, and not for evaluation.

    Args:
        first: First seed.
        count: Number of seeds from the first one on.
        asked: Beginning of the error's message, which says what was asked for.

    Raises:
        InvalidArgumentError: A seed is negative, or for evaluation.
    """
    if not 0 <= first <= FIRST_EVALUATION_SEED - count:
        raise InvalidArgumentError(
            f"{asked}demonstrations have the seeds 0 to {FIRST_EVALUATION_SEED - 1}, because those from "
            f"{FIRST_EVALUATION_SEED} on are for evaluation"
        )


def make_header(env_id: str, env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """The json of a trajectory file, without its episodes.

    The environment's id has gymnasium's form "module:id", so that ManiSkill's tools import the module that registers it. The
    render backend is left out, because it is a choice of each machine.

    Args:
        env_id: Id of the task.
        env_kwargs: Arguments of the environment.

    Raises:
        UnknownNameError: The task is not registered.
        InvalidArgumentError: The observation mode has an unknown token.
    """
    spec = task_spec(env_id)
    split_obs_mode(env_kwargs["obs_mode"])  # before any process is started
    kept = {name: value for name, value in env_kwargs.items() if name != "render_backend"}
    max_steps = kept.get("max_episode_steps") or spec.max_episode_steps
    return dict(
        env_info=dict(env_id=spec.gym_id, env_kwargs=kept, max_episode_steps=max_steps),
        source_type="scripted",
        source_desc="manifeel_ms3 demonstrator that acts within the policy's controller and on what the pads feel",
        commit_info=None if (commit := git_commit()) is None else dict(commit_id=commit),
        versions=package_versions(),
        revision=spec.revision,
    )


def trajectory_name(env_id: str, env_kwargs: dict[str, Any]) -> str:
    """Name of a trajectory file by ManiSkill's convention, which tells what the file holds.

    The name is "trajectory.{obs_mode}.{control_mode}.{sim_backend}.h5"; a file without observations is "trajectory.h5".

    Args:
        env_id: Id of the task.
        env_kwargs: Arguments of the environment.

    Raises:
        UnknownNameError: The task is not registered.
    """
    obs_mode = env_kwargs.get("obs_mode", "none")
    if obs_mode == "none":
        return STATES_FILE
    return f"trajectory.{obs_mode}.{task_spec(env_id).control_mode(env_kwargs)}.{env_kwargs.get('sim_backend', 'physx_cpu')}.h5"


def observed_file(folder: Path, obs_mode: str = "") -> Path | None:
    """A trajectory file with observations in a folder, the first in the order of names; None if there is none.

    Files of earlier versions are found, too: there, `trajectory.h5` held observations.

    Args:
        folder: The folder.
        obs_mode: Observations, joined by "+", of which a file that has all of them is preferred.
    """
    first, wanted = None, set(filter(None, obs_mode.split("+")))
    for path in filter(Path.is_file, [*sorted(folder.glob("trajectory.*.h5")), folder / STATES_FILE]):
        held = read_header(path)["env_info"]["env_kwargs"].get("obs_mode", "none")
        if held != "none":
            if wanted <= set(held.split("+")):
                return path
            first = first or path
    return first


@contextmanager
def open_recording(path: Path, header: dict[str, Any], order: Sequence[int] | None = None) -> Iterator["Recording"]:
    """Hold a trajectory file for as long as the context lasts, to add episodes to it.

    Args:
        path: The trajectory file, which need not exist.
        header: The json of the file, without its episodes. `failed_seeds` is kept up to date if it is among the fields. Where
            the file says already who recorded it (`ORIGIN`), that stays, and the further episodes' entries name what differs.
        order: Seeds in the order in which their episodes enter the file; the order in which they finish if not given.

    Raises:
        InvalidArgumentError: The file's name does not end in .h5.
        InUseError: Another process records into the file; the message names it.
        DemonstrationError: The file was recorded with other arguments or another revision of the task, or is damaged.
        MachineError: The folder cannot be written.
    """
    if path.suffix != ".h5":  # peg.h5 and peg.hdf5 would share peg.json
        raise InvalidArgumentError(f"{path} is not a path of a trajectory file; give one that ends in .h5")
    with owned(path):
        recording = Recording(path, header, order)
        try:
            yield recording
        except BaseException:  # Ctrl-C, too
            recording.withdraw()
            raise


class Recording:
    """A trajectory file to which episodes are added; `open_recording` makes one.

    Worker processes write episodes into `drafts`, a folder of this recording session alone; `accept` moves them into the folder
    of episodes. A worker that outlives a killed session therefore cannot write into a later one.

    Args:
        path: The trajectory file.
        header: The json of the file, without its episodes.
        order: Seeds in the order in which their episodes enter the file; the order in which they finish if not given.
    """

    def __init__(self, path: Path, header: dict[str, Any], order: Sequence[int] | None):
        self.path = path
        self.infos: dict[int, dict[str, Any]] = {}
        """Json entries of the episodes in the file, by seed in the order of the file."""
        self.kept: dict[int, dict[str, Any]] = {}
        """Json entries of episodes that an earlier session has finished but not yet entered into the file, by seed."""
        self.failed: set[int] = set()
        """Seeds whose episodes failed."""
        self.is_complete = False
        """Whether the file holds its episodes itself and is not an index."""
        self._is_new = not path.exists()
        self._waiting: dict[int, dict[str, Any]] = {}
        self._header, self._order = header, order
        self._origin = {name: header.get(name) for name in ORIGIN}
        self._folder = episode_folder(path)
        self.drafts = self._folder / f"{SESSION}{uuid4().hex}"
        """Folder into which the workers of this session write episodes."""
        if path.is_file():
            self._load()
        elif finished_episodes(self._folder):
            raise DemonstrationError(
                f"{self._folder} holds episodes of a recording whose file {path} is missing; put the file back, or move the "
                "folder away, or give another --out"
            )
        else:
            self._require_free_json()

    def _require_free_json(self) -> None:
        """Check that the json of a new file replaces no file of another kind, such as the result of an evaluation."""
        path = self.path.with_suffix(".json")
        if not path.exists():
            return
        try:
            read_json(path, HEADER, "a trajectory's json")
        except InvalidFileError as error:
            raise DemonstrationError(
                f"{path} is no recording's json; {self.path} needs its place; give another path"
            ) from error

    def _load(self) -> None:
        before = read_header(self.path)
        asked = {name: self._header[name] for name in ("env_info", "revision")}
        for name, recorded, wanted in differing({n: before.get(n, value) for n, value in asked.items()}, asked):
            raise DemonstrationError(
                f"{self.path} was recorded with {name}={recorded!r}, this run asks for {wanted!r}; give another --out, "
                "or delete the file"
            )
        self.failed = set(before.get("failed_seeds", []))
        self.is_complete = not is_index(self.path)
        if self.is_complete:
            remove_folder(self._folder)
            self.infos = {info["episode_seed"]: info for info in before["episodes"]}
            self._keep_origin(before)
            return
        found = finished_episodes(self._folder)
        seeds = indexed_seeds(self.path)
        if lost := [seed for seed in seeds if seed not in found or not episode_file(self._folder, seed).is_file()]:
            raise DemonstrationError(
                f"{self.path} lacks the episodes of the seeds {lost}, which should be in {self._folder}; put that folder back, "
                "or delete the file to record anew"
            )
        self.infos = {seed: found.pop(seed) for seed in seeds}
        self.kept = found
        if self.infos or self.kept:
            self._keep_origin(before)

    def _keep_origin(self, before: dict[str, Any]) -> None:
        """Let the file's header say of its episodes what it said before this session."""
        unsaid = set(ORIGIN) - before.keys()
        kept = {name: value for name, value in self._header.items() if name not in unsaid}
        self._header = kept | {name: before[name] for name in ORIGIN if name in before}

    @property
    def num_finished(self) -> int:
        """Number of episodes in the file, and of those that wait until the seeds before theirs are done."""
        return len(self.infos) + len(self._waiting)

    def begin(self) -> None:
        """Prepare the file for further episodes.

        Raises:
            FileWriteError: The folder cannot be written.
        """
        if self.is_complete:
            separate(self.path)
            self.is_complete = False
        write_index(self.path, self._fields(), self.infos)
        for stale in self._folder.glob(f"{SESSION}*"):  # left by sessions that were killed
            remove_folder(stale)
        self.drafts.mkdir(parents=True)

    def withdraw(self) -> None:
        """Delete what this session has begun, if it holds nothing yet: it would refuse the corrected arguments."""
        if self._is_new and not (self.infos or self._waiting or self.failed):
            remove_folder(self._folder)
            for path in (self.path, self.path.with_suffix(".json")):
                path.unlink(missing_ok=True)

    def accept(self, seed: int, info: dict[str, Any]) -> int:
        """Take over an episode that lies among the drafts.

        Args:
            seed: Seed of the episode.
            info: The episode's entry in the json; what it says of the episode's origin precedes what the header says.

        Returns:
            Number of episodes by which the file has grown.

        Raises:
            FileWriteError: The episode cannot be written; the recording is as it was before.
        """
        file = episode_file(self._folder, seed)
        entry = file.with_suffix(".json")
        origin = self._origin | {name: info[name] for name in ORIGIN if name in info}
        own = {name: value for name, value in origin.items() if value != self._header.get(name)}
        info = {name: value for name, value in info.items() if name not in ORIGIN} | dict(episode_seed=seed) | own
        move(self.drafts / file.name, file)
        try:
            write_json(entry, info)
            return self._enter({seed: info})
        except FileWriteError:
            if seed not in indexed_seeds(self.path):
                entry.unlink(missing_ok=True)
            raise

    def accept_kept(self, seed: int) -> int:
        """Take over an episode of `kept`, and return the number of episodes by which the file has grown."""
        return self._enter({seed: self.kept.pop(seed)})

    def reject(self, seed: int) -> int:
        """Remember that an episode failed, and return the number of episodes by which the file has grown."""
        self.failed.add(seed)
        return self._enter({})

    def _enter(self, finished: dict[int, dict[str, Any]]) -> int:
        """Append the finished episodes whose turn it is, and return the number of episodes by which the file has grown."""
        infos, waiting = dict(self.infos), self._waiting | finished
        for seed in list(waiting) if self._order is None else self._order:
            if seed in waiting:
                infos[seed] = waiting.pop(seed)
            elif seed not in infos and seed not in self.failed:
                break
        write_index(self.path, self._fields(), infos)
        more = len(infos) - len(self.infos)
        self.infos, self._waiting = infos, waiting
        return more

    def finish(self) -> None:
        """Turn the index and the episodes into one file; a recording without episodes leaves no file."""
        if self.infos:
            consolidate(self.path)
        else:
            remove_recording(self.path)

    def _fields(self) -> dict[str, Any]:
        """The json of the file as it is now, without its episodes."""
        failed = dict(failed_seeds=sorted(self.failed)) if "failed_seeds" in self._header else {}
        return self._header | failed


@dataclass(frozen=True)
class Recorder:
    """State of a worker process that records: one environment, and the folder that its episodes are written to."""

    env: gym.Env
    env_id: str
    drafts: Path
    """Folder of the recording session, `Recording.drafts`."""
    source: gym.Env | None = None
    """Environment with the controller of the recording that is replayed, if its actions are converted to another."""

    def write(self, episode: RecordedEpisode) -> dict[str, Any]:
        """Write an episode, and return its entry in the json."""
        write_episode(self.drafts, episode)
        return episode.info | dict(episode_seed=episode.seed)


def make_recorder(
    env_id: str, env_kwargs: dict[str, Any], drafts: Path, source_kwargs: dict[str, Any] | None = None
) -> Recorder:
    """Make the state of a worker process; `source_kwargs` are the arguments of the environment `Recorder.source`."""
    source = None if source_kwargs is None else make_env(env_id, **source_kwargs)
    return Recorder(make_env(env_id, **env_kwargs), env_id, drafts, source)


def next_step(_args: Any, path: Path) -> str:
    """Text for the end of a command that writes a trajectory file: what the file holds, and which commands take it.

    Args:
        _args: Arguments of the command.
        path: Path of the file.
    """
    header = read_header(path)
    recorded = header["env_info"]
    count, seen = len(header["episodes"]), recorded["env_kwargs"]
    held = f"{path} holds {count} episode{'s' * (count != 1)}"
    rendering = as_typed("manifeel", "render-observations", path, "--out", "FILE")
    if seen["obs_mode"] == "none":
        return f"{held}; {rendering} adds observations"
    if not (train := train_command(path, header)):
        rendered = f"{rendering} makes a file with cameras and touch instead"
        return f"{held}; no policy is trained on the obs_mode {seen['obs_mode']}: {rendered}"
    return f"{held}; {as_typed('manifeel', 'view', path)} shows them, {train} trains a policy"


def train_command(demonstrations: Path, header: dict[str, Any]) -> str:
    """The command that trains a policy on what was recorded, in backquotes and quoted for a shell; "" if none can be.

    Args:
        demonstrations: Path of the trajectory file, or of what was exported from it.
        header: The json beside the trajectory file.
    """
    seen = header["env_info"]["env_kwargs"]
    if not (obs_mode := _learnable(seen.get("obs_mode", "none"))):
        return ""
    words = ["manifeel", "train", "diffusion_policy", "cpu", "--demo-path", demonstrations]
    words += ["--env-id", task_of(header), "--obs-mode", obs_mode]
    cameras = names_in(seen.get("cameras"))  # other programs name them only where they are not the task's policy camera
    if cameras and "rgb" in obs_mode.split("+"):
        words += ["--cameras", *cameras]
    pads = names_in(seen.get("tactile_sensors"))
    if pads and "right" not in pads:  # policies observe the right one unless told otherwise
        words += ["--tactile-sensors", *pads]
    return as_typed(*words)


def _learnable(obs_mode: str) -> str:
    """The part of an observation mode that policies are trained on; empty if there is none.

    Every policy needs the pose of the tool, which is a part of a vector in the mode `state`.
    """
    tokens = ["rgb" if token == "rgbd" else token for token in obs_mode.split("+")]
    return "" if "state" in tokens else "+".join(token for token in tokens if token in ("rgb", *TACTILE_TOKENS))
