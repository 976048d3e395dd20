"""A file appears whole or not at all, and errors name the path."""

import json
import os
import shutil
import signal
import socket
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from manifeel_ms3.arguments import require_file
from manifeel_ms3.errors import InvalidArgumentError, InvalidFileError, MachineError, ManifeelError, ServerError
from manifeel_ms3.files import (
    ABANDONED_AFTER,
    MOST_UNPACKED,
    FileWriteError,
    atomic_folder,
    atomic_write,
    read_json,
    read_json_lines,
    read_npz,
    remove_folder,
    remove_leftovers,
    restore_folder,
    write_json,
    write_text,
)
from manifeel_ms3.paths import derived_file
from tests.trust.kills import forked

SCHEMA = {"type": "object", "required": ["count"], "properties": {"count": {"type": "integer"}}}


def test_json_is_read_as_it_was_written_and_folders_are_made(tmp_path):
    path = tmp_path / "folder/file.json"
    write_json(path, dict(count=3))
    assert read_json(path, SCHEMA, "a count") == dict(count=3)
    assert path.read_text() == json.dumps(dict(count=3), indent=2)
    assert [file.name for file in path.parent.iterdir()] == ["file.json"]


def test_a_failed_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "file.txt"
    write_text(path, "old")

    def write_half() -> None:
        with atomic_write(path) as partial:
            partial.write_text("ne")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ManifeelError, match=r"file/page.html cannot be written \(.*exists"):
        write_text(tmp_path / "file/page.html", "")


@pytest.mark.parametrize("make", [atomic_write, atomic_folder])
def test_only_what_is_about_the_output_is_said_of_it(tmp_path, make):
    missing = tmp_path / "input.h5"

    def fail_with(fail) -> None:
        with make(tmp_path / "out") as partial:
            fail(partial)

    def reach_no_server(_partial: Path) -> None:
        raise ServerError("no server answers; start it")

    with pytest.raises(FileNotFoundError) as raised:
        fail_with(lambda _partial: missing.read_bytes())
    assert (raised.type, raised.value.filename) == (FileNotFoundError, str(missing))
    with pytest.raises(ServerError, match=r"^no server answers; start it$"):
        fail_with(reach_no_server)
    with pytest.raises(FileWriteError, match="out cannot be written"):
        fail_with(lambda partial: (partial / "folder/file").write_text(""))
    assert list(tmp_path.iterdir()) == []


def test_a_derived_file_whose_source_is_missing_is_no_matter_of_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("MANIFEEL_CACHE_DIR", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"source\.stl"):
        derived_file("mesh.obj", (tmp_path.parent / "source.stl").read_bytes)
    (tmp_path / "file").write_text("")
    with pytest.raises(MachineError, match=r"derived files cannot be kept in .*\(.*file.*\); set MANIFEEL_CACHE_DIR"):
        derived_file("file/mesh.obj", lambda: "")


@pytest.mark.parametrize(
    ("text", "reason"), [("{", "Expecting"), ("{}", "'count' is a required"), ('{"count": "x"}', "count: 'x'")]
)
def test_what_is_no_such_json_is_refused(tmp_path, text, reason):
    (tmp_path / "file.json").write_text(text)
    with pytest.raises(InvalidFileError, match=rf"file.json is not a count \(.*{reason}"):
        read_json(tmp_path / "file.json", SCHEMA, "a count")
    with pytest.raises(InvalidFileError, match=r"none.json is not a count \(.*No such file"):
        read_json(tmp_path / "none.json", SCHEMA, "a count")


def test_two_processes_that_write_the_same_file_do_not_mix_their_texts(tmp_path):
    path = tmp_path / "page.html"
    with atomic_write(path) as first, atomic_write(path) as second:
        first.write_text("first")
        second.write_text("second, and longer")
    assert path.read_text() == "first"  # the last to finish
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("is_link", [False, True])
@pytest.mark.parametrize("make", [atomic_write, atomic_folder])
def test_what_a_killed_writer_left_is_deleted_by_the_next(tmp_path, make, is_link):
    child = os.fork()
    if child == 0:
        with make(tmp_path / "x") as partial:
            if partial.is_dir():
                (partial / "half").write_text("half")
            elif is_link:  # as that of the last checkpoint
                partial.symlink_to("/")
            else:
                partial.write_text("half")
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert len(list(tmp_path.iterdir())) == 1
    with make(tmp_path / "x") as partial:
        (partial / "whole" if partial.is_dir() else partial).write_text("whole")
    assert list(tmp_path.iterdir()) == [tmp_path / "x"]


@pytest.mark.parametrize("make", [atomic_write, atomic_folder])
def test_what_another_machine_writes_is_deleted_only_when_it_is_old(tmp_path, make, monkeypatch):
    """The number of its process says nothing here."""
    with monkeypatch.context() as there:
        there.setattr(os, "getpid", lambda: 2**22 + 1)  # a number that no process has
        there.setattr(socket, "gethostname", lambda: "another-machine.lab")
        writer = make(tmp_path / "x")
        partial = writer.__enter__()
    half = partial / "file" if partial.is_dir() else partial
    half.write_text("half")
    old = time.time() - ABANDONED_AFTER - 60
    for written, is_kept in ((old + 120, True), (old, False)):
        os.utime(partial, (old, old))
        os.utime(half, (written, written))
        with make(tmp_path / "x") as own:
            (own / "file" if own.is_dir() else own).write_text("whole")
        assert half.exists() is is_kept
        shutil.rmtree(tmp_path / "x") if make is atomic_folder else (tmp_path / "x").unlink()


def test_what_another_process_is_writing_at_this_moment_is_no_leftover(tmp_path):
    with atomic_write(tmp_path / "x.json") as partial:
        partial.write_text("whole")
        partial.with_name(partial.name.replace(f"-{os.getpid()}-", f"-{2**22 + 1}-")).touch()  # no process has this number
        remove_leftovers(tmp_path)
        assert list(tmp_path.iterdir()) == [partial]
    assert (tmp_path / "x.json").read_text() == "whole"


def test_the_next_removal_of_a_folder_completes_one_that_was_killed(tmp_path):
    for name in ("x[1]", ".x[1].machine-123-abc.partial"):
        (tmp_path / name).mkdir()
    remove_folder(tmp_path / "x[1]")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_takes_the_place_of_another_only_where_it_may(tmp_path):
    for replace, text in ((False, "old"), (True, "new")):
        with atomic_folder(tmp_path / "x", replace=replace) as partial:
            (partial / text).write_text(text)
    with pytest.raises(ManifeelError, match="x cannot be written"), atomic_folder(tmp_path / "x"):
        pass
    assert [path.name for path in tmp_path.rglob("*")] == ["x", "new"]


def test_lines_of_a_log_that_broke_off_are_left_out(tmp_path):
    log = tmp_path / "log.jsonl"
    assert read_json_lines(log) == []
    log.write_bytes(b'{"step": 1}\n[2]\n\xff\n' + b"[" * 10**5 + b'\n{"step": 3}\n{"st')
    assert read_json_lines(log) == [dict(step=1), dict(step=3)]


def test_a_folder_that_is_replaced_is_the_old_or_the_new_one_whenever_its_writer_is_killed(tmp_path):
    def replace(path: Path, text: str) -> None:
        with atomic_folder(path, replace=True) as partial:
            (partial / "file").write_text(text)

    path = tmp_path / "counted/x"
    replace(path, "old")
    events = forked(lambda _: replace(path, "new"))[1]
    assert events > 5
    for moment in range(events):
        path = tmp_path / f"killed{moment}/x"
        replace(path, "old")
        assert forked(lambda _, path=path: replace(path, "new"), moment)[0] == -signal.SIGKILL
        restore_folder(path)
        assert (path / "file").read_text() in ("old", "new")
        replace(path, "newer")
        assert (path / "file").read_text() == "newer"
        assert [entry.name for entry in path.parent.iterdir()] == ["x"]


def test_what_is_no_npz_is_refused(tmp_path):
    path = tmp_path / "x.npz"
    np.savez(path, a=np.arange(3))
    assert read_npz(path, "a table")["a"].tolist() == [0, 1, 2]
    with pytest.raises(InvalidFileError, match=r"x.npz is not a table \(.*'?b"):
        read_npz(path, "a table", ["b"])
    np.savez(path, a=np.array([dict()], dtype=object))
    with pytest.raises(InvalidFileError, match=r"x.npz is not a table \(Object arrays cannot be loaded"):
        read_npz(path, "a table")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w", force_zip64=True) as file:
        for _ in range(MOST_UNPACKED // 2**20 + 1):
            file.write(bytes(2**20))
    with pytest.raises(InvalidFileError, match=r"it unpacks to 537,919,488 bytes, more than 536,870,912"):
        read_npz(path, "a table")
    for content in (b"", b"PK\x03\x04junk", b"\x93NUMPY"):
        path.write_bytes(content)
        with pytest.raises(InvalidFileError, match=r"x\.npz is not a table"):
            read_npz(path, "a table")


def test_a_file_that_cannot_be_made_is_named_before_the_work(tmp_path):
    (tmp_path / "file").write_text("kept")
    require_file("--out", tmp_path / "new/folder/page.html", "page.html")
    with pytest.raises(InvalidArgumentError, match=rf"--out .* cannot be written, because {tmp_path / 'file'} is a file"):
        require_file("--out", tmp_path / "file/folder/page.html", "page.html")
    with pytest.raises(InvalidArgumentError, match=r"--out .* is a folder; give the path of a file, such as .*page\.html"):
        require_file("--out", tmp_path, "page.html")
