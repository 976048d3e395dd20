"""What is built is whole: the wheel made from the source archive has every asset, and works from any folder."""

import os
import re
import subprocess
import sys
import tarfile
import venv
import zipfile
from importlib.metadata import requires, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement

REPOSITORY = Path(__file__).parents[1]
MAKE = """
import manifeel_ms3, gymnasium
gymnasium.make('ManiFeel-PegInsertion-v1', obs_mode='state').reset(seed=0)
env = gymnasium.make('ManiFeel-PegInsertion-v1', obs_mode='tacrgb', render_backend='none')
touched = env.reset(seed=0)[0]['sensor_data']['tactile_right']
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from the source archive alone."""
    folder = tmp_path_factory.mktemp("dist")
    _build("sdist", REPOSITORY, folder)
    with tarfile.open(next(folder.glob("*.tar.gz"))) as archive:
        archive.extractall(folder / "source", filter="data")
    (source,) = (folder / "source").iterdir()
    _build("wheel", source, folder)
    return next(folder.glob("*.whl"))


def _build(target: str, source: Path, out: Path) -> None:
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(out)], cwd=source, check=True)


def test_the_wheel_holds_all_that_the_packages_hold(wheel):
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
    packages = [REPOSITORY / name for name in ("manifeel_ms3", "baselines")]
    files = [path for package in packages for path in package.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    missing = {path.relative_to(REPOSITORY).as_posix() for path in files} - inside
    assert not missing
    assert {f"manifeel_ms3/data/{path.name}" for path in (REPOSITORY / "data").iterdir() if path.is_file()} <= inside


def test_the_source_archive_is_that_of_a_package_and_not_of_the_whole_repository(wheel):
    (archive,) = wheel.parent.glob("*.tar.gz")
    assert archive.stat().st_size < 5e6  # with the leaderboard's checkpoints it has 114 MB, and PyPI takes at most 100


def dependency(name: str) -> Requirement:
    """The requirement on a package in pyproject.toml."""
    (asked,) = re.findall(rf'"({name}[<>=][^"]*)"', (REPOSITORY / "pyproject.toml").read_text())
    return Requirement(asked)


def test_gymnasium_has_the_modes_of_automatic_resets_that_evaluation_names():
    """They came with version 1.1, which ManiSkill allows; the pinned version is a later one."""
    asked = dependency("gymnasium").specifier
    assert not asked.contains("1.0.0")
    (theirs,) = (one for line in requires("mani-skill") or [] if (one := Requirement(line)).name == "gymnasium")
    (pinned,) = re.findall(r"^gymnasium==([\d.]+)", (REPOSITORY / "requirements.lock").read_text(), flags=re.MULTILINE)
    assert all(specifier.contains(one) for specifier in (asked, theirs.specifier) for one in ("1.1.0", pinned))


def test_it_works_from_any_folder(wheel, tmp_path):
    site = tmp_path / "site"
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(site), str(wheel)], check=True)

    def python(*arguments: str) -> subprocess.CompletedProcess:
        where = os.environ | dict(PYTHONPATH=str(site))
        command = [sys.executable, *arguments]
        return subprocess.run(command, cwd=tmp_path, env=where, capture_output=True, text=True, check=False)

    done = python("-c", f"{MAKE}print(manifeel_ms3.__file__, touched['rgb'].shape)")
    assert str(site) in done.stdout, done.stderr
    assert "240, 320, 3" in done.stdout
    refused = python("-m", "manifeel_ms3.cli", "tasks", "Knitting")
    assert refused.returncode == 1
    assert (site / "manifeel_ms3/data/troubleshooting.md").is_file()
    assert str(site) in refused.stderr.partition("more: ")[2]


@pytest.mark.slow
def test_it_installs_in_a_clean_environment(wheel, tmp_path):
    """With all that it needs, from the registry: minutes, and 2 GB where torch comes without CUDA."""
    venv.create(tmp_path / "env", with_pip=True)
    programs = tmp_path / "env/bin"
    torch = version("torch").partition("+")[0]
    subprocess.run([programs / "pip", "install", "-q", str(wheel), f"torch=={torch}"], check=True)
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    for command in ([programs / "python", "-c", MAKE], [programs / "manifeel", "tasks"], [programs / "manifeel", "doctor"]):
        done = subprocess.run(command, cwd=tmp_path, env=clean, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
