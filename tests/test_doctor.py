"""The doctor finds what is wrong, and says how to mend it."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from manifeel_ms3 import doctor
from tests.tasks_and_marks import needs_renderer


@needs_renderer
def test_a_machine_that_is_in_order():
    said = []
    findings = doctor.examine(said.append)
    assert said == [finding.what for finding in findings]  # each check was announced
    assert {finding.what for finding in findings} >= {
        "Python",
        "packages",
        "a step with images",
        "a step with touch",
        "disk, here",
    }
    assert [finding for finding in findings if finding.ok is False and finding.what != "disk, here"] == []


def test_a_machine_without_a_renderer():
    """As on a machine without Mesa, the Vulkan loader finds no driver."""
    environment = os.environ | dict(VK_ICD_FILENAMES="/nowhere.json", VK_DRIVER_FILES="/nowhere.json", CUDA_VISIBLE_DEVICES="")
    command = [sys.executable, "-m", "manifeel_ms3.doctor"]
    done = subprocess.run(command, env=environment | dict(COLUMNS="200"), capture_output=True, text=True, check=False)
    assert done.returncode == 1
    lines = {line.split("│")[2].strip(): line for line in done.stdout.splitlines() if line.count("│") == 5}
    assert "wrong" in lines["a step with images"]
    assert "Error: " in lines["a step with images"]
    assert "Mesa 24.3" in done.stdout
    assert "ok" in lines["a step with touch"]  # which needs no picture


def test_packages_of_another_version(monkeypatch):
    real = doctor.version
    monkeypatch.setattr(doctor, "version", lambda name: "2.2.0" if name == "sapien" else real(name))
    (finding,) = [one for one in doctor._packages() if one.ok is False]
    assert (finding.what, finding.found) == ("sapien", "2.2.0")
    assert finding.remedy.startswith("pip install 'sapien")


def test_a_crash_is_a_finding():
    ran = doctor._run("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    assert not ran.worked
    assert ran.reason == "crashed (signal 11)"


def test_a_full_disk_and_a_cache_that_cannot_be_written(monkeypatch, tmp_path):
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: SimpleNamespace(free=1e9))
    assert doctor._disk().ok is False
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("MANIFEEL_CACHE_DIR", str(tmp_path / "file"))
    assert doctor._cache().ok is False
    assert "MANIFEEL_CACHE_DIR" in doctor._cache().remedy
    failed = doctor._Ran(False, "", "MachineError: derived files cannot be kept in /none; set MANIFEEL_CACHE_DIR")
    monkeypatch.setattr(doctor, "_run", lambda _: failed)
    assert {doctor._images().remedy, doctor._simulation().remedy} == {doctor._cache().remedy}


def test_the_page_about_trouble_shows_the_columns_and_the_checks_of_the_program():
    page = (Path(__file__).parents[1] / "docs/troubleshooting.md").read_text()
    heads = [cell.strip() for cell in next(line for line in page.splitlines() if line.startswith("┃")).split("┃")[1:-1]]
    assert heads == [column.header for column in doctor.table([]).columns]
    rows = ([cell.strip() for cell in line.split("│")[1:-1]] for line in page.splitlines() if line.startswith("│"))
    shown = {row[1] for row in rows} - {""}
    assert shown == set(doctor._checks())


@pytest.mark.parametrize("here", [(3, 9), (3, 13)])
def test_another_python(monkeypatch, here):
    monkeypatch.setattr(doctor.sys, "version_info", (*here, 0))
    assert doctor._python().ok is False
