"""scripts/setup.sh: which mirror it uses, what it removes again, how it looks for libraries, and what it installs."""

import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

SETUP = Path(__file__).parents[2] / "scripts/setup.sh"
RELEASE = """Origin: {origin}
Codename: bookworm
Suite: {suite}
Components: main
Architectures: amd64 arm64
Date: Sat, 01 Jan 2022 00:00:00 UTC
"""
needs_apt = pytest.mark.skipif(shutil.which("apt-get") is None, reason="no apt on this machine")


def run(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Bash that has sourced the script, with all places of the system under a folder; `as_root` needs no root there."""
    places = {
        "BACKPORTS": folder / "sources.list.d/manifeel-backports.list",
        "INSTALLED": folder / "manifeel_ms3/packages",
        "LAVAPIPE": folder / "lavapipe",
        "LAVAPIPE_ICD": folder / "icd.d/lvp_icd.json",
    }
    lines = [f"{name}='{place}'" for name, place in places.items()]
    lines = [f"source '{SETUP}'", *lines, 'as_root() { "$@"; }', program]
    environment = os.environ | {"APT_CONFIG": str(folder / "apt.conf")}
    return subprocess.run(["bash", "-c", "\n".join(lines)], env=environment, capture_output=True, text=True, check=False)


def repository(folder: Path, origin: str, suite: str = "bookworm") -> str:
    """A repository on the disk with an empty list of packages; its address."""
    lists = folder / "dists" / suite / "main"
    for machine in ("amd64", "arm64"):
        (lists / f"binary-{machine}").mkdir(parents=True)
        (lists / f"binary-{machine}/Packages").write_text("")
    (lists.parent / "Release").write_text(RELEASE.format(origin=origin, suite=suite))
    return f"file:{folder}/"


@pytest.fixture
def apt(tmp_path):
    """A folder in the place of /etc/apt, and apt's lists beside it."""
    for name in ("sources.list.d", "lists/partial", "cache/archives/partial", "icd.d"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "apt.conf").write_text(
        f'Dir::Etc "{tmp_path}"; Dir::Etc::sourcelist "{tmp_path}/sources.list";\n'
        f'Dir::Etc::sourceparts "{tmp_path}/sources.list.d";\n'
        f'Dir::State::Lists "{tmp_path}/lists"; Dir::Cache "{tmp_path}/cache"; APT::Sandbox::User "root";\n'
        'Acquire::Retries "0"; Acquire::Check-Valid-Until "false";\n'
    )
    return tmp_path


def one_line(uri: str, suite: str = "bookworm") -> str:
    return f"deb [trusted=yes] {uri} {suite} main\n"


def deb822(uri: str, suite: str = "bookworm") -> str:
    return f"Types: deb\n# a comment\nURIs: {uri}\nSuites: {suite}\nComponents: main\nTrusted: yes\n"


@needs_apt
@pytest.mark.parametrize("form", [one_line, deb822])
def test_a26_the_mirror_is_debians_and_not_that_of_the_first_source(form, apt):
    """Of the repositories that call themselves bookworm, with a component main; the first one is Google's."""
    ending = "list" if form is one_line else "sources"
    google = repository(apt / "packages.cloud.google.com/debian", "Google")
    debian = repository(apt / "mirror", "Debian")
    (apt / f"sources.list.d/cloudsdk.{ending}").write_text(form(google))
    (apt / f"sources.list.d/debian.{ending}").write_text(form(debian))
    done = run("apt-get update -q >/dev/null; debians_mirror bookworm", apt)
    assert done.stdout.strip() == debian, done.stderr


@needs_apt
def test_a26_without_a_source_of_debian_there_is_no_mirror(apt):
    (apt / "sources.list.d/cloudsdk.list").write_text(one_line(repository(apt / "google", "Google")))
    (apt / "sources.list.d/never-fetched.list").write_text(one_line("file:/nowhere/debian"))
    done = run("apt-get update -q >/dev/null 2>&1 || true; debians_mirror bookworm", apt)
    assert (done.returncode, done.stdout) == (0, "")


@needs_apt
def test_a26_what_debian_has_not_signed_is_not_added(apt):
    """A mirror whose list of packages nobody signed, though it claims to be Debian's."""
    (apt / "os-release").write_text("ID=debian\nVERSION_ID=12\n")
    forged = repository(apt / "forged", "Debian")
    repository(apt / "forged", "Debian Backports", "bookworm-backports")
    (apt / "sources.list.d/debian.list").write_text(one_line(forged))
    done = run(
        "OS_RELEASE=$1; apt-get update -q >/dev/null; add_mesa_source || echo refused".replace("$1", f"{apt}/os-release"), apt
    )
    assert "refused" in done.stdout, done.stdout + done.stderr
    assert not (apt / "sources.list.d/manifeel-backports.list").exists()
    assert subprocess.run(["apt-get", "update", "-q"], env=os.environ | {"APT_CONFIG": str(apt / "apt.conf")}).returncode == 0


@needs_apt
def test_a26_backports_that_are_there_are_not_added_again(apt):
    """Two sources of one suite with different keys would stop apt altogether."""
    (apt / "os-release").write_text("ID=debian\nVERSION_ID=12\n")
    there = repository(apt / "mirror", "Debian Backports", "bookworm-backports")
    (apt / "sources.list.d/debian.list").write_text(one_line(there, "bookworm-backports"))
    program = f"OS_RELEASE={apt}/os-release; apt-get update -q >/dev/null; add_mesa_source; echo ${{MESA_RELEASE[*]}}"
    done = run(program, apt)
    assert done.stdout.strip() == "-t bookworm-backports", done.stderr
    assert not (apt / "sources.list.d/manifeel-backports.list").exists()


@needs_apt
def test_a26_undo_takes_back_what_was_added_and_nothing_else(apt):
    other, added = apt / "sources.list.d/debian.list", apt / "sources.list.d/manifeel-backports.list"
    other.write_text("")
    added.write_text(one_line("file:/nowhere", "bookworm-backports"))
    (apt / "lavapipe").mkdir()
    (apt / "lavapipe/libvulkan_lvp.so").write_text("")
    for name in ("lvp_icd.json", "nvidia_icd.json"):
        (apt / "icd.d" / name).write_text("{}")
    done = run("undo", apt)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in (apt / "icd.d").iterdir()) == ["nvidia_icd.json"]
    assert not added.exists()
    assert not (apt / "lavapipe").exists()
    assert other.exists()
    assert "Left:" in done.stdout
    assert "Removed: nothing" in run("undo", apt).stdout


def test_a26_undo_gives_up_the_packages_that_were_installed(apt):
    """apt then removes those that no other package needs; packages that were there before are not named."""
    marks = 'apt-mark() { echo apt-mark "$@"; }'
    done = run(f"remember libegl1 chromium; remember libegl1; {marks}; undo", apt)
    assert done.returncode == 0, done.stderr
    assert "apt-mark auto chromium libegl1\n" in done.stdout
    assert "apt-get autoremove" in done.stdout
    assert "apt-mark" not in run(f"{marks}; undo", apt).stdout


def test_a26_without_root_undo_says_what_it_cannot_remove(apt):
    (apt / "sources.list.d/manifeel-backports.list").write_text("")
    done = run("as_root() { return 1; }; undo", apt)
    assert done.returncode == 1
    assert "cannot be removed" in done.stdout


def test_a26_an_unknown_flag_installs_nothing():
    done = subprocess.run([SETUP, "--undoo"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "usage" in done.stderr


def test_a27_a_long_list_of_libraries_is_read_as_a_whole(apt, tmp_path):
    """`ldconfig` that says more than a pipe holds, and dies of a reader that has left."""
    program = tmp_path / "bin/ldconfig"
    program.parent.mkdir()
    program.write_text(
        f"#!/bin/bash\necho call >>'{tmp_path}/calls'\n"
        'for k in {1..4000}; do echo "libvulkan.so.1 of line $k" || exit 1; done\n'
    )
    program.chmod(0o755)
    ask = "for k in {1..20}; do has_library libvulkan.so.1 || echo missing; done; has_library libnone.so || echo none"
    done = run(f"PATH={program.parent}:$PATH\n{ask}", apt)
    assert done.stdout.split() == ["none"]
    assert (tmp_path / "calls").read_text().split() == ["call"]


def test_b10_python_is_one_for_which_packages_are_locked(tmp_path):
    for name, version in (("python3", "3, 13"), ("python3.12", "3, 14"), ("python3.11", "3, 11")):
        asked = f'"import sys; sys.version_info = ({version}, 0); ${{2#*; }}"'
        (tmp_path / name).write_text(f"#!/bin/bash\n'{sys.executable}' -c {asked}\n")
        (tmp_path / name).chmod(0o755)
    found = run(f"PATH='{tmp_path}:/usr/bin:/bin'\nfind_python && echo $PYTHON", tmp_path)
    assert found.stdout.split() == ["python3.11"]
    (tmp_path / "python3.11").unlink()
    none = run(f"PATH='{tmp_path}'\nfind_python || echo refused", tmp_path)
    assert "Python 3.10, 3.11 or 3.12 is needed" in none.stdout
    assert none.stdout.split()[-1] == "refused"


def test_b10_the_image_is_named_by_its_content_and_has_git():
    lines = (SETUP.parents[1] / "Dockerfile").read_text().splitlines()
    (base,) = [line for line in lines if line.startswith("FROM ")]
    name, _, digest = base.partition("@sha256:")
    assert name.startswith("FROM python:3.")
    assert len(digest) == 64
    assert int(digest, 16)
    assert any("apt-get install" in line and " git " in line for line in lines)
    ignored = (SETUP.parents[1] / ".dockerignore").read_text().split()
    assert ".git" not in ignored  # without it, results made in the image could not name their commit


def test_b10_every_package_is_installed_by_its_hash():
    lock = (SETUP.parents[1] / "requirements.lock").read_text()
    pins = re.split(r"^(?=[a-z])", lock, flags=re.MULTILINE)[1:]
    assert len(pins) > 100
    assert all(re.match(r"[\w.-]+==", pin) and "--hash=sha256:" in pin for pin in pins)
    for file in (SETUP, SETUP.parents[1] / "Dockerfile"):
        installs = [line for line in file.read_text().splitlines() if "-r requirements.lock" in line]
        assert installs
        assert all("--no-deps --require-hashes" in line for line in installs)
        (package,) = [line for line in file.read_text().splitlines() if line.endswith(" -e .")]
        assert "--no-deps --no-build-isolation" in package  # it is built with what the lock pins
    pinned = {canonicalize_name(pin.partition("==")[0]) for pin in pins}
    assert {"hatchling", "editables"} <= pinned
    needed = [Requirement(need) for need in requires("torch") or []]
    needed = {canonicalize_name(need.name) for need in needed if not need.marker or need.marker.evaluate(dict(extra=""))}
    assert {name for name in needed if not name.startswith(("nvidia-", "cuda-", "triton"))} <= pinned  # torch pins these itself


def test_b02_an_older_torch_is_replaced_by_the_pinned_one(tmp_path):
    """A `.venv` of an earlier version, with torch 2.9 and a pip that writes down what it is asked for."""
    python = tmp_path / ".venv/bin/python"
    python.parent.mkdir(parents=True)
    python.write_text('#!/bin/bash\ncase "$*" in *torch.__version__*) echo 2.9.0 ;; *) echo "$*" >>calls ;; esac\n')
    python.chmod(0o755)
    program = f'source "{SETUP}"\ncd "{tmp_path}"\ninstall_python_packages >/dev/null\necho "$TORCH_VERSION"'
    version = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True).stdout.strip()
    assert tuple(map(int, version.split(".")[:2])) >= (2, 10)
    assert f"torch=={version}" in (tmp_path / "calls").read_text()


def test_the_code_that_names_the_renderer_runs():
    code = re.search(r"Renderer: \$\(\.venv/bin/python -c '(.*?)'\)", SETUP.read_text())
    found = subprocess.run([sys.executable, "-c", code[1]], capture_output=True, text=True, check=True)
    assert found.stdout.strip() in ("gpu", "cpu", "none")
