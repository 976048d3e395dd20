"""The leaderboard.

    python -m manifeel_ms3.leaderboard submit my_submission --checkpoint runs/x/checkpoints/last
    python -m manifeel_ms3.leaderboard build

A submission is a folder with submission.json ({"name", "authors", "link"}), with the result files of a policy in any
subfolders, one for each checkpoint and training seed, and optionally with `videos/*.mp4`. `submit` checks a submission and
copies it into the leaderboard's folder; `build` makes index.html and README.md from all submissions there.
"""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from manifeel_ms3.command_line import json_object, run
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation.policy import PolicySource

from .page import write_page
from .submission import ABOUT, check, read_submission, run_again, take

log = logging.getLogger(__name__)


@dataclass
class Submit:
    """Check a submission, and copy it into the leaderboard."""

    folder: tyro.conf.Positional[Path]
    """Folder of the submission."""
    checkpoint: Path | None = None
    """Checkpoint folder of one of the results; some of its episodes are run again."""
    policy: str | None = None
    """Policy of the results, if it has no checkpoint: a class that can be imported ("module:Class"), or the address of a
    server."""
    policy_kwargs: str = "{}"
    """Keyword arguments of the policy, as json."""
    rerun: int = 3
    """Number of episodes that are run again."""
    board: Path = Path("leaderboard")
    """Folder of the leaderboard."""
    check_only: bool = False
    """Check the submission without copying it."""


@dataclass
class Build:
    """Make the leaderboard's page and table."""

    board: Path = Path("leaderboard")
    """Folder of the leaderboard."""


Args = Annotated[Submit, tyro.conf.subcommand("submit")] | Annotated[Build, tyro.conf.subcommand("build")]


def main(args: Submit | Build) -> Path:
    """Run one of the two commands, and return the page, or the folder of the submission.

    Raises:
        SubmissionError: The submission cannot be accepted; the message lists everything that is wrong with it.
        FileExistsAlreadyError: The leaderboard has a submission of the same name.
        InvalidArgumentError: No policy is given to run episodes with.
    """
    if isinstance(args, Build):
        submissions = [read_submission(path.parent) for path in sorted(args.board.glob(f"*/{ABOUT}"))]
        path = write_page(submissions, args.board)
        log.info("%s, of %d submissions", path, len(submissions))
        return path
    submission = read_submission(args.folder)
    check(submission)
    if (args.checkpoint is None) == (args.policy is None):
        raise InvalidArgumentError(
            "give either --checkpoint or --policy: some episodes are run again before a submission is accepted"
        )
    json_object("--policy-kwargs", args.policy_kwargs)
    run_again(submission, PolicySource(args.checkpoint, args.policy, args.policy_kwargs), args.rerun)
    log.info("%s is accepted: %d results, %d episodes run again", args.folder, len(submission.results), args.rerun)
    return args.folder if args.check_only else take(submission, args.board)


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
