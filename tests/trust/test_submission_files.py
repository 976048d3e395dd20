"""A submission comes from a stranger: nothing but its own files reaches the leaderboard, whole or not at all."""

import os
import random
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest

from manifeel_ms3.errors import FileExistsAlreadyError, InUseError
from manifeel_ms3.files import FileWriteError
from manifeel_ms3.leaderboard import untrusted
from manifeel_ms3.leaderboard.__main__ import Build, Submit, main
from manifeel_ms3.leaderboard.adding import take
from manifeel_ms3.leaderboard.page import rows_on
from manifeel_ms3.leaderboard.submission import SubmissionError, read_submission
from manifeel_ms3.ownership import owned
from tests.leaderboard.made_up import made_up

from .submissions import FIRST, contents

# ------------------------------------------------------------------ whole or not at all

COPY = ".theirs.*.partial"
"""Pattern of the folder that a submission is copied to before it takes its name."""


def num_copied(board: Path) -> int:
    """Number of files in the copy of a submission, which may take its name, and so disappear, while they are counted."""
    return sum(len(names) for copy in board.glob(COPY) for _, _, names in os.walk(copy))  # `os.walk` passes over what is gone


def taken_until_killed(folder: Path, board: Path, files: int, delay: float) -> bool:
    """Take a submission in a process that is killed a moment after this many files; return whether it was still at work."""
    submission = read_submission(folder)
    if (child := os.fork()) == 0:
        try:
            take(submission, board)
        finally:
            os._exit(0)
    ended = (0, 0)
    while not ended[0] and num_copied(board) < files:
        ended = os.waitpid(child, os.WNOHANG)
    time.sleep(delay)
    if not ended[0]:
        os.kill(child, signal.SIGKILL)
        ended = os.waitpid(child, 0)
    return ended[1] == signal.SIGKILL


@pytest.mark.parametrize("kills", [6, pytest.param(100, marks=pytest.mark.slow)])
def test_a10_a_submission_that_is_killed_while_it_is_taken_is_whole_or_absent(tmp_path, kills, figure):
    folder = made_up(tmp_path / "theirs", "Theirs", "PegInsertion", "rgb", 10, seeds=3, steps=3)
    expected, rng, killed = contents(folder), random.Random(0), 0
    for number in range(kills):
        board = tmp_path / f"board{number}"
        killed += taken_until_killed(folder, board, rng.randint(0, len(expected)), rng.uniform(0, 0.003))
        if (board / "theirs").exists():
            assert contents(board / "theirs") == expected
            with pytest.raises(FileExistsAlreadyError):
                take(read_submission(folder), board)
        else:
            assert rows_on(board) == []
            assert contents(take(read_submission(folder), board)) == expected
        assert len(rows_on(board)) == 1
        assert not list(board.glob(COPY))
    figure(f"of {kills} processes killed while they take a submission, number hit at work", killed, at_least=kills // 3)


def test_a10_a_copy_that_fails_leaves_nothing(folder, tmp_path):
    board = tmp_path / "board"
    submission = read_submission(folder)
    with owned(board / "theirs"), pytest.raises(InUseError, match="in use by process"):
        take(submission, board)
    broken = replace(submission, files=submission.files | {Path("submission.json/below"): b"in the way"})
    with pytest.raises(FileWriteError, match=r"theirs cannot be written"):
        take(broken, board)
    assert [path for path in board.iterdir() if path.is_dir()] == []
    assert contents(take(submission, board)) == contents(folder)


def test_a10_only_what_was_checked_is_taken(folder, tmp_path):
    (folder / "notes.txt").write_text("not for the board")
    (folder / "results/a.mp4").write_bytes(b"not in videos")
    submission = read_submission(folder)
    (folder / FIRST).write_text("exchanged after the check")
    taken = contents(take(submission, tmp_path / "board"))
    assert set(taken) == {"submission.json", *(path.as_posix() for path in submission.results)}
    assert b"exchanged" not in taken[FIRST]
    odd = read_submission(shutil.copytree(tmp_path / "board/theirs", tmp_path / "a | b"))
    with pytest.raises(SubmissionError, match="rename the folder"):
        take(odd, tmp_path / "board")


# ------------------------------------------------------------------ its own regular files only


def link_to_a_secret(folder: Path, secret: Path) -> None:
    (folder / "videos").mkdir()
    (folder / "videos/a.mp4").symlink_to(secret)


def link_to_a_folder(folder: Path, secret: Path) -> None:
    (folder / "videos").symlink_to(secret.parent)


def link_in_a_folder(folder: Path, secret: Path) -> None:
    (folder / "results/9").symlink_to(secret.parent, target_is_directory=True)


def broken_link(folder: Path, secret: Path) -> None:
    (folder / "more.json").symlink_to("nowhere")


def pipe(folder: Path, secret: Path) -> None:
    os.mkfifo(folder / "endless.json")


@pytest.mark.parametrize("harm", [link_to_a_secret, link_to_a_folder, link_in_a_folder, broken_link, pipe])
def test_a14_links_and_special_files_are_refused(folder, tmp_path, harm):
    secret = tmp_path / "mine/secret.mp4"
    secret.parent.mkdir()
    secret.write_bytes(b"PRIVATE KEY")
    harm(folder, secret)
    with pytest.raises(SubmissionError, match="symbolic link or a special file"):
        main(Submit(folder, rerun=0, board=tmp_path / "board"))
    assert not (tmp_path / "board").exists()
    board = tmp_path / "by_hand"  # somebody has put it into the leaderboard by hand
    board.mkdir()
    folder.rename(board / "theirs")
    page = main(Build(board))
    assert b"PRIVATE KEY" not in page.read_bytes()
    assert "Theirs" not in page.read_text()


def test_a14_a_linked_folder_is_no_submission(folder, tmp_path):
    (tmp_path / "link").symlink_to(folder)
    with pytest.raises(SubmissionError, match="give the folder itself"):
        read_submission(tmp_path / "link")
    board = tmp_path / "board"
    board.mkdir()
    (board / "theirs").symlink_to(folder)
    assert rows_on(board) == []


def test_a14_files_have_a_limit_of_size(folder, tmp_path, monkeypatch):
    (folder / "videos").mkdir()
    with (folder / "videos/a.mp4").open("wb") as file:
        file.truncate(2**40)  # takes no room on the disk
    with pytest.raises(SubmissionError, match="more than 16 MiB"):
        read_submission(folder)
    (folder / "videos/a.mp4").unlink()
    (folder / "padded.json").write_text(" " * (2**20 + 1))
    with pytest.raises(SubmissionError, match="more than 1 MiB"):
        read_submission(folder)
    (folder / "padded.json").unlink()
    for name, most, word in (("MOST_ENTRIES", 5, "more than 5 files"), ("LARGEST_TOTAL", 9, "leave some videos out")):
        with monkeypatch.context() as limited:
            limited.setattr(untrusted, name, most)
            with pytest.raises(SubmissionError, match=word):
                read_submission(folder)
    deep = folder / "/".join("d" * 300)
    deep.mkdir(parents=True)
    with pytest.raises(SubmissionError, match="nested deeper than 8"):
        read_submission(folder)
