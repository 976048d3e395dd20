"""The leaderboard.

    python -m manifeel_ms3.leaderboard submit my_submission --checkpoint runs/x/checkpoints/last
    python -m manifeel_ms3.leaderboard build

A submission is a folder with submission.json ({"name", "authors", "link"}), the result files of a policy, one a checkpoint and
training seed, in any folders, and, if wanted, `videos/*.mp4`. `submit` checks it and puts it into the leaderboard's folder;
`build` makes index.html and README.md of all that is there.
"""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from manifeel_ms3.command_line import run
from manifeel_ms3.evaluation.policy import PolicySource

from . import page
from .submission import ABOUT, check, read_submission, run_again, take

log = logging.getLogger(__name__)


@dataclass
class Submit:
    """Check a submission, and put it into the leaderboard."""

    folder: tyro.conf.Positional[Path]
    checkpoint: Path | None = None
    """of one of its results; some of its episodes are run again"""
    policy: str | None = None
    """instead: a policy of your own, "module:Class" or a server's address"""
    policy_kwargs: str = "{}"
    rerun: int = 3
    """episodes run again"""
    board: Path = Path("leaderboard")
    check_only: bool = False
    """do not put it there"""


@dataclass
class Build:
    """Make the page and the table."""

    board: Path = Path("leaderboard")


Args = Annotated[Submit, tyro.conf.subcommand("submit")] | Annotated[Build, tyro.conf.subcommand("build")]


def main(args: Submit | Build) -> Path:
    """Returns what was written.

    Raises:
        SubmissionError: the submission cannot be taken; the message lists all that is wrong.
    """
    if isinstance(args, Build):
        submissions = [read_submission(path.parent) for path in sorted(args.board.glob(f"*/{ABOUT}"))]
        log.info("%s, of %d submissions", args.board / page.PAGE, len(submissions))
        return page.write(submissions, args.board)
    submission = read_submission(args.folder)
    check(submission)
    if args.checkpoint is None and args.policy is None:
        raise SystemExit("give --checkpoint or --policy: some episodes are run again before a submission is taken")
    run_again(submission, PolicySource(args.checkpoint, args.policy, args.policy_kwargs), args.rerun)
    log.info("%s is in order: %d results, %d episodes run again", args.folder, len(submission.results), args.rerun)
    return args.folder if args.check_only else take(submission, args.board)


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
