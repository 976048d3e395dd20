"""Taking a checked submission into the folder of the leaderboard, as a whole or not at all."""

import os
import re
import shutil
from pathlib import Path

from manifeel_ms3.errors import FileExistsAlreadyError
from manifeel_ms3.files import FileWriteError, atomic_write, flush
from manifeel_ms3.ownership import owned

from .submission import RERUN, Rerun, Submission, SubmissionError

INCOMING = ".incoming"
"""Folder of the leaderboard that a submission is copied to before it takes its name; the rest of an interrupted
copy is removed by the next one."""
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
        InUseError: Another process copies a submission.
        SubmissionError: The name of the folder has characters that are not allowed, or is too long.
    """
    name = submission.folder.resolve().name
    if not NAME.fullmatch(name):
        raise SubmissionError(submission.folder, ["its name may have letters, digits, ., _ and - only; rename the folder"])
    target, incoming = board / name, board / INCOMING
    contents = submission.files | ({RERUN: rerun.to_json()} if rerun else {})
    with owned(incoming):
        if os.path.lexists(target):
            raise FileExistsAlreadyError(
                f"{target} exists already; rename the folder of the new submission, or delete the old one"
            )
        shutil.rmtree(incoming, ignore_errors=True)
        try:
            for path, content in contents.items():
                with atomic_write(incoming / path) as partial:
                    partial.write_bytes(content)
            for folder in {incoming / parent for path in contents for parent in path.parents}:
                flush(folder)
            incoming.rename(target)
            flush(board)
        except FileWriteError:
            raise
        except OSError as error:
            raise FileWriteError(f"{target} cannot be written ({error}); make room or get the permission") from error
        finally:
            shutil.rmtree(incoming, ignore_errors=True)
    return target
