"""One process at a time owns a file; whoever comes second is told who does, and a killed process leaves nothing that blocks."""

import os
import subprocess
import sys
import threading
import time

import pytest

from manifeel_ms3.errors import InUseError, MachineError
from manifeel_ms3.ownership import is_owned, owned
from manifeel_ms3.processes import process_exists

HOLD = """
import sys, time
from manifeel_ms3.ownership import owned

with owned(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""
PATIENCE = 60  # s


@pytest.fixture
def holder(tmp_path):
    """Another process that holds `tmp_path / "file.h5"`."""
    command = [sys.executable, "-c", HOLD, str(tmp_path / "file.h5"), "argument " * 100]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait(PATIENCE)


def test_the_second_process_is_told_who_holds_the_file(holder, tmp_path):
    with pytest.raises(InUseError, match=f"process {holder.pid} on .* since 20") as error, owned(tmp_path / "file.h5"):
        pass
    assert str(error.value).count("argument") < 10  # the beginning of its command
    with owned(tmp_path / "other.h5"):  # another file is free
        pass


def test_whether_a_file_is_held(holder, tmp_path):
    assert is_owned(tmp_path / "file.h5")
    assert not is_owned(tmp_path / "other.h5")
    holder.kill()
    holder.wait(PATIENCE)
    assert not is_owned(tmp_path / "file.h5")


def test_to_ask_whether_a_file_is_held_disturbs_nobody(tmp_path):
    """To ask takes the lock for a moment, in which one who comes to hold the file must not be refused."""
    ended = threading.Event()

    def ask():
        while not ended.is_set():
            is_owned(tmp_path / "file.h5")

    asking = threading.Thread(target=ask)
    asking.start()
    try:
        for _ in range(100):
            with owned(tmp_path / "file.h5"):
                assert (tmp_path / ".file.h5.holder.json").is_file()
    finally:
        ended.set()
        asking.join()


def test_a_killed_process_leaves_nothing_that_blocks(holder, tmp_path):
    holder.kill()
    holder.wait(PATIENCE)
    begin = time.monotonic()
    with owned(tmp_path / "file.h5"):
        assert time.monotonic() - begin < 1.0


def test_a_process_may_hold_a_file_again(tmp_path):
    for _ in range(2):
        with owned(tmp_path / "new folder/Übung.h5"):
            assert not (tmp_path / "new folder/Übung.h5").exists()


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(MachineError, match="file cannot be written"), owned(tmp_path / "file/inside.h5"):
        pass


def test_a_process_exists_until_it_has_ended():
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    assert process_exists(process.pid)
    process.kill()
    process.wait(PATIENCE)
    assert not process_exists(process.pid)
    assert process_exists(os.getpid())
    assert process_exists(1)  # perhaps another user's
    assert not any(map(process_exists, (0, -1, -os.getpgrp(), 10**30)))  # a damaged file of status may hold them
