"""Taking a checked submission into the folder of the leaderboard, as a whole or not at all."""

import os
import re
from pathlib import Path

from manifeel_ms3.errors import FileExistsAlreadyError
from manifeel_ms3.files import atomic_folder
from manifeel_ms3.ownership import owned

from .submission import RERUN, Rerun, Submission, SubmissionError

NAME = re.compile(r"\w[\w.-]{0,99}", re.ASCII)
"""Names of folders that the leaderboard takes: at most 100 letters, digits, underscores, dots and hyphens."""


def take(submission: Submission, board: Path, rerun: Rerun | None = None) -> Path:
    """Copy a checked submission into a leaderboard's folder, and return the copy.

    The contents that were checked are written, not copied from the folder a second time; other files stay behind.

    Args:
        submission: The submission.
        board: Folder of the leaderboard.
        rerun: The episodes that were run again, if any.

    Raises:
        FileExistsAlreadyError: The leaderboard has a submission of the same name.
        FileWriteError: The leaderboard's folder cannot be written.
        InUseError: Another process copies a submission of the same name.
        SubmissionError: The name of the folder has characters that are not allowed, or is too long.
    """
    target = free_place(submission, board)
    contents = submission.files | ({RERUN: rerun.to_json()} if rerun else {})
    with owned(target):
        free_place(submission, board)
        with atomic_folder(target) as partial:
            for path, content in contents.items():
                file = partial / path
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(content)
    return target


def free_place(submission: Submission, board: Path) -> Path:
    """The folder that a submission comes into, which must not exist.

    Raises:
        FileExistsAlreadyError: The leaderboard has a submission of the same name.
        SubmissionError: The name of the folder has characters that are not allowed, or is too long.
    """
    name = submission.folder.resolve().name
    if not NAME.fullmatch(name):
        raise SubmissionError(submission.folder, ["its name may have letters, digits, ., _ and - only; rename the folder"])
    if os.path.lexists(board / name):
        raise FileExistsAlreadyError(
            f"{board / name} exists already; rename the folder of the new submission, or delete the old one"
        )
    return board / name
