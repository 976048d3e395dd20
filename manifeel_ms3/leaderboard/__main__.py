"""The leaderboard.

    manifeel leaderboard hash my_submission --checkpoint runs/x/checkpoints
    manifeel leaderboard submit my_submission --checkpoint runs/x/checkpoints
    manifeel leaderboard build

A submission is a folder with submission.json ({"name", "authors", "link"}), with the result files of a policy in any
subfolders, one for each checkpoint and training seed, and optionally with videos: videos/PegInsertion/rgb.mp4 is shown with the
results in PegInsertion/rgb, and one that is named by no folder of results with all of them. `hash` writes into submission.json
the hash of each result's checkpoint. `submit` checks a submission, runs episodes of all its results again, and copies it into
the leaderboard's folder; `build` makes index.html and README.md from all submissions there.
"""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from manifeel_ms3.arguments import require_not_negative, require_positive
from manifeel_ms3.command_line import as_typed, json_object, run
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation.policy import PolicySource
from manifeel_ms3.files import write_json

from .adding import free_place, take
from .checks import check, check_is_new
from .page import rows_on, write_page
from .rerun import about_with_checkpoints, checkpoint_sources, name_checkpoints, policy_sources, run_again
from .submission import ABOUT, Submission, read_submission

log = logging.getLogger(__name__)


@dataclass
class Hash:
    """Write the hashes of the results' checkpoints into submission.json."""

    folder: tyro.conf.Positional[Path]
    """Folder of the submission."""
    checkpoint: tuple[Path, ...]
    """Checkpoint folders of all results, or folders that hold them."""


@dataclass
class Submit:
    """Check a submission, and copy it into the leaderboard."""

    folder: tyro.conf.Positional[Path]
    """Folder of the submission."""
    checkpoint: tuple[Path, ...] = ()
    """Checkpoint folders of all results, or folders that hold them; submission.json must name their hashes."""
    policy: str | None = None
    """Policy of the results, if it has no checkpoint: a class that can be imported ("module:Class"), or the address of a
    server."""
    policy_kwargs: str = "{}"
    """Keyword arguments of the policy, as json."""
    rerun: int | None = None
    """Largest number of episodes that are run again for each row of the page. If not given, as many as it takes to detect a
    row with a tenth of invented outcomes in 99 of 100 cases; a smaller number proves less, and the page says so. With 0 no
    policy is needed."""
    seed: int | None = None
    """Seed of the draw of these episodes, to repeat an earlier draw; a new one if not given."""
    workers: Annotated[int, tyro.conf.arg(name="num-eval-envs", aliases=["--workers"])] = 1
    """Number of processes that run episodes side by side."""
    board: Path = Path("leaderboard")
    """Folder of the leaderboard."""
    check_only: bool = False
    """Check the submission without copying it."""


@dataclass
class Build:
    """Make the leaderboard's page and table."""

    board: Path = Path("leaderboard")
    """Folder of the leaderboard."""


Args = (
    Annotated[Hash, tyro.conf.subcommand("hash")]
    | Annotated[Submit, tyro.conf.subcommand("submit")]
    | Annotated[Build, tyro.conf.subcommand("build")]
)


def main(args: Hash | Submit | Build) -> Path:
    """Run one of the commands, and return the path that it made: submission.json, the folder of the submission, or the page.

    Raises:
        SubmissionError: The submission cannot be accepted; the message lists what is wrong with it.
        FileExistsAlreadyError: The leaderboard has a submission of the same name.
        InvalidArgumentError: No policy is given to run episodes with, a folder of --checkpoint holds no checkpoint, or a number
            is not allowed.
    """
    if isinstance(args, Build):
        return _build(args)
    if isinstance(args, Submit):
        require_positive(num_eval_envs=args.workers)
        require_not_negative(rerun=args.rerun)
    submission = read_submission(args.folder)
    if isinstance(args, Hash):
        named = name_checkpoints(submission, args.checkpoint)
        write_json(args.folder / ABOUT, about_with_checkpoints(submission, named))
        log.info("%s names the checkpoints of %d results", args.folder / ABOUT, len(named))
        return args.folder / ABOUT
    check(submission)
    check_is_new(submission, args.board)
    if not args.check_only:
        free_place(submission, args.board)  # before episodes are run again
    rerun = None
    if args.rerun != 0:
        rerun = run_again(submission, _sources(submission, args), args.rerun, args.seed, args.workers)
    count = sum(len(file.episodes) for file in rerun.files.values()) if rerun else 0
    log.info("%s is accepted: %d results, %d episodes run again", args.folder, len(submission.results), count)
    return args.folder if args.check_only else take(submission, args.board, rerun)


def _build(args: Build) -> Path:
    if not args.board.is_dir():
        raise InvalidArgumentError(
            f"--board {args.board} is no folder; give that of a leaderboard, such as `leaderboard` in a copy of the repository"
        )
    rows = rows_on(args.board)
    path = write_page(rows, args.board)
    log.info("%s, of %d submissions", path, len({row.submission.folder for row in rows}))
    return path


def _sources(submission: Submission, args: Submit) -> dict[Path, PolicySource]:
    json_object("--policy-kwargs", args.policy_kwargs)
    if args.policy is not None and not args.checkpoint:
        return policy_sources(submission, args.policy, args.policy_kwargs)
    if args.policy is None and args.checkpoint:
        return checkpoint_sources(submission, args.checkpoint, args.policy_kwargs)
    raise InvalidArgumentError(
        "give either --checkpoint or --policy: some episodes are run again before a submission is accepted; with --rerun 0 "
        "none are, and the page says so"
    )


def next_step(args: Hash | Submit | Build, made: Path) -> str:
    """What the command made, and what one can do with it."""
    if isinstance(args, Hash):
        submission = as_typed("manifeel", "leaderboard", "submit", args.folder, "--checkpoint", *args.checkpoint)
        return f"{made} names them; {submission} checks and takes it"
    if isinstance(args, Build):
        return f"{made} is a page to open in a browser"
    if args.check_only:
        return f"{made} is not taken yet; the same command without --check-only takes it"
    build = as_typed("manifeel", "leaderboard", "build", "--board", args.board)
    return f"{made} is on the leaderboard; {build} makes its page anew"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
