"""Submissions: folders with submission.json, the result files of one policy, and videos.

`data/submission_schema.json` and `data/evaluation_schema.json` define the form of the files. A submission is read once: its
checks, the copy in the leaderboard and the page are made from the contents that were read.
"""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import jsonschema

from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.evaluation.entries import ABOUT as ABOUT_NAME
from manifeel_ms3.evaluation.entries import VIDEO_SUFFIX, VIDEOS
from manifeel_ms3.evaluation.result import check_result
from manifeel_ms3.files import SHOWN_LENGTH
from manifeel_ms3.paths import data_dir

from .links import is_safe_link
from .untrusted import FolderReader, UntrustedFileError, parse_json, quoted

ABOUT, RERUN = Path(ABOUT_NAME), Path("rerun.json")
"""Files of a submission: its description by the authors, and the episodes that the leaderboard ran again."""
SHOWN_FAULTS = 20
"""Largest number of faults that a message lists."""
SHOWN_FOREIGN = 3
"""Largest number of unknown files that a message lists."""


class SubmissionError(InvalidFileError):
    """A submission cannot be accepted; the message lists what is wrong with it."""

    def __init__(self, folder: Path, faults: list[str]):
        more = [f"{len(faults) - SHOWN_FAULTS} more faults"] if len(faults) > SHOWN_FAULTS else []
        lines = "\n".join(f"- {fault}" for fault in faults[:SHOWN_FAULTS] + more)
        super().__init__(f"{quoted(folder)} cannot be accepted:\n{lines}")


@dataclass(frozen=True)
class About:
    """The content of submission.json."""

    name: str
    """Name of the submission."""
    authors: str
    """Names of the authors."""
    link: str = ""
    """Address of the paper, the code or the weights."""
    checkpoints: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the checkpoint of each result, by the path of the result file in the submission."""


@dataclass(frozen=True)
class RerunFile:
    """The episodes of one result file that the leaderboard ran again with the same outcome."""

    sha256: str
    """Hash of the result file."""
    episodes: list[int]
    """Seeds of the episodes."""


@dataclass(frozen=True)
class Rerun:
    """The content of rerun.json, which the leaderboard writes into the folder of a submission that it takes."""

    seed: int
    """Seed of the draw of episodes."""
    versions: dict[str, str]
    """Versions of the packages that ran the episodes again."""
    files: dict[str, RerunFile]
    """The result files by their paths in the submission."""

    def to_json(self) -> bytes:
        """The content of rerun.json."""
        return json.dumps(asdict(self), indent=2).encode()


@dataclass(frozen=True)
class Submission:
    """A folder with results of one policy, as it was read."""

    folder: Path
    """The folder."""
    about: About
    """Content of submission.json."""
    results: dict[Path, dict[str, Any]]
    """Contents of the result files, by their paths in the folder."""
    files: dict[Path, bytes]
    """Bytes of submission.json, the result files and the videos, by their paths in the folder."""
    rerun: Rerun | None = None
    """Content of rerun.json, if there is one; it counts only in a folder of the leaderboard, which wrote it."""

    def videos_of(self, results: Iterable[Path]) -> list[bytes]:
        """The videos of some results, in the order of their paths.

        The video videos/PegInsertion/rgb.mp4 is of the results in the folder PegInsertion/rgb. One that is named by no folder
        of results is of all of them.

        Args:
            results: Paths of result files in the submission.
        """
        own, all_of_them = ({folder for path in paths for folder in path.parents} for paths in (results, self.results))
        shown = {path: path.relative_to(VIDEOS).with_suffix("") for path in sorted(self.files) if path.suffix == VIDEO_SUFFIX}
        return [self.files[path] for path, named in shown.items() if named in own or named not in all_of_them]


def read_submission(folder: Path) -> Submission:
    """Read a submission, and check that its files have the published form.

    Raises:
        SubmissionError: A file is missing, does not have the form, is too large or is no regular file.
    """
    read = FolderReader(folder)
    faults, results, about, rerun = read.faults, {}, None, None
    if ABOUT not in read.contents:
        faults.append(f'it holds no {ABOUT}; write {{"name": ..., "authors": ..., "link": ...}} into it')
    for path in sorted(path for path in read.contents if path.suffix == ".json"):
        try:
            content = parse_json(read.contents[path], path)
            if path == ABOUT:
                about = _about(content)
            elif path == RERUN:
                rerun = _rerun(content)
            else:
                check_result(content, path)
                _check_form(content, path, "result")
                results[path] = content
        except InvalidFileError as error:
            faults.append(str(error))
    if not results and not faults:
        faults.append("it holds no result; add the result files that `manifeel eval` wrote")
    if about is None or faults:
        raise SubmissionError(folder, faults)
    if foreign := sorted(set(about.checkpoints) - {path.as_posix() for path in results}):
        faults = [f"{ABOUT} names checkpoints of {foreign[:SHOWN_FOREIGN]}, which are no result files here"]
        raise SubmissionError(folder, faults)
    shown = {path: content for path, content in read.contents.items() if path in results or _is_video(path)}
    return Submission(folder, about, results, {ABOUT: read.contents[ABOUT]} | shown, rerun)


def _is_video(path: Path) -> bool:
    return Path(VIDEOS) in path.parents and path.suffix == VIDEO_SUFFIX


def _about(content: Any) -> About:
    _check_form(content, ABOUT)
    about = About(**content)
    for name in ("name", "authors"):
        text = getattr(about, name)
        if not text.strip() or not text.isprintable():
            raise UntrustedFileError(f"{ABOUT}: {name} must be one line of printable characters")
    if about.link and not is_safe_link(about.link):
        raise UntrustedFileError(
            f"{ABOUT}: the link must be an address like https://example.org/paper, without a password, with every special "
            "character as %-code"
        )
    return about


def _rerun(content: Any) -> Rerun:
    _check_form(content, RERUN, "rerun")
    files = {name: RerunFile(**entry) for name, entry in content["files"].items()}
    return Rerun(content["seed"], content["versions"], files)


def _check_form(content: Any, path: Path, part: str | None = None) -> None:
    """Check a content against the schema of submissions, or a part of its definitions."""
    schema = json.loads((data_dir() / "submission_schema.json").read_text(encoding="utf-8"))
    if part:
        schema = {"$ref": f"#/$defs/{part}", "$defs": schema["$defs"]}
    for error in jsonschema.Draft202012Validator(schema).iter_errors(content):
        place = "/".join(str(part) for part in error.absolute_path) or "the whole file"
        raise UntrustedFileError(f"{quoted(path)}: {place}: {error.message[:SHOWN_LENGTH]}")
