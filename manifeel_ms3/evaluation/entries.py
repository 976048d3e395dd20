"""Entries of the leaderboard whose checkpoints are in the repository, so that anyone can run them again.

An entry is a folder such as leaderboard/cpu/PegInsertion/rgb+tacff. Its folder seed0 has the result of the first training seed,
such as `00007000.json`, and its checkpoint, `checkpoints/00007000`. The submission.json of the submission (here
leaderboard/cpu) names the hash of every checkpoint.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manifeel_ms3.errors import InvalidFileError, UnknownNameError
from manifeel_ms3.files import read_json
from manifeel_ms3.paths import CHECKPOINTS, leaderboard_dir

from .agreement import differences
from .checkpoint_config import published_hash
from .result import read_result
from .rollout import EpisodeOutcome

ABOUT = "submission.json"
"""File that names the checkpoints' hashes."""
VIDEOS, VIDEO_SUFFIX = "videos", ".mp4"
"""Folder of a submission's videos, in which videos/PegInsertion/rgb.mp4 is that of PegInsertion/rgb, and the ending of their
names."""
SETTINGS = ("env_kwargs", "revision", "inference", "stop_at_success")
"""Parts of a result that say, beside the policy's configuration, what was evaluated, and how; only results that have the same
can be compared by episode."""
CHECKPOINT_HASHES = {
    "type": "object",
    "properties": {"checkpoints": {"type": "object", "additionalProperties": {"type": "string"}}},
}
"""Json schema of what an entry needs of its submission: the hashes of its checkpoints by result."""


@dataclass(frozen=True)
class Entry:
    """A result of the leaderboard with its checkpoint."""

    name: str
    """Path of the entry's folder on the leaderboard, such as "cpu/PegInsertion/rgb+tacff"."""
    result: dict[str, Any]
    """Content of the result file."""
    checkpoint: Path
    """Folder of the checkpoint."""

    def unlike(self, result: dict[str, Any]) -> list[str]:
        """Names of the settings of a result that are not the entry's; its outcomes may then differ on any machine."""
        config, own = result["config"], self.result["config"]
        of_the_policy = sorted(name for name in config.keys() | own.keys() if config.get(name) != own.get(name))
        return [name for name in SETTINGS if result[name] != self.result[name]] + of_the_policy

    def agreement(self, outcomes: list[EpisodeOutcome]) -> str:
        """Sentence that says how many of the given outcomes agree with those of the entry.

        If some differ, it also has the number of successes on both sides and the first difference.
        """
        submitted = {episode["seed"]: episode for episode in self.result["episodes"]}
        compared = [outcome for outcome in outcomes if outcome.seed in submitted]
        if not compared:
            return f"no episode is compared with those of the entry {self.name}, which has other seeds"
        differing = {one.seed: found for one in compared if (found := differences(submitted[one.seed], one))}
        sentence = f"{len(compared) - len(differing)} of {len(compared)} episodes agree with those of the entry {self.name}"
        if not differing:
            return sentence
        seed, found = next(iter(differing.items()))
        here, there = sum(one.success_once for one in compared), sum(submitted[one.seed]["success_once"] for one in compared)
        versions, machine = self.result["versions"], self.result["machine"]
        return (
            f"{sentence}; {here} succeed here, {there} there. In the episode of seed {seed}, {found[0]}. It was evaluated with "
            f"torch {versions['torch']} on {machine['cpu']}; other versions and processors round differently"
        )


def published_checkpoints(board: Path) -> list[Path]:
    """Folders of all checkpoints on a leaderboard, sorted."""
    return sorted(board.glob(f"*/**/{CHECKPOINTS}/*"))


def find_entry(name: str) -> Entry:
    """The entry with a given name.

    Args:
        name: Path of the entry's folder on the leaderboard, such as "cpu/PegInsertion/rgb+tacff".

    Raises:
        UnknownNameError: There is no such entry with a checkpoint; the message lists the entries that have one. Or there is no
            leaderboard, because the package is not installed from a copy of the repository.
        InvalidFileError: The checkpoint is not the one that the submission names.
        ResultError: The result is broken.
    """
    board = leaderboard_dir()
    if not board.is_dir():
        raise UnknownNameError(
            f"{board} does not exist: only a copy of the repository has the entries; install the package from one with "
            "`pip install -e .`"
        )
    known = {path.parents[2].relative_to(board).as_posix(): path for path in published_checkpoints(board)}
    if not known:
        raise UnknownNameError(
            f"{board.resolve()} has no entries with checkpoints; run the command in a copy of the repository"
        )
    if name not in known:
        raise UnknownNameError(f"no entry {name!r} with a checkpoint is in {board}; choose from {list(known)}")
    checkpoint = known[name]
    path = checkpoint.parents[1] / f"{checkpoint.name}.json"
    submission = board / Path(name).parts[0]
    named = _checkpoints_of(submission / ABOUT).get(path.relative_to(submission).as_posix())
    if named != (found := published_hash(checkpoint)):
        raise InvalidFileError(
            f"{checkpoint} has the hash {found}, but {submission / ABOUT} names {named}: the checkpoint was changed; get it "
            "anew from the repository"
        )
    return Entry(name, read_result(path), checkpoint)


def _checkpoints_of(path: Path) -> dict[str, str]:
    return read_json(path, CHECKPOINT_HASHES, "a submission").get("checkpoints", {})
