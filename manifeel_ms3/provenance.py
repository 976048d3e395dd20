"""The code and the machine that a result comes from."""

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

PACKAGES = ("manifeel-ms3", "mani-skill", "sapien", "torch")
"""Packages whose versions a result records."""


def package_versions() -> dict[str, str]:
    """Installed versions of the packages that decide an outcome."""
    return {name: version(name) for name in PACKAGES}


def git_commit() -> str | None:
    """Commit of this package's own repository, followed by "-dirty" if files of the repository have uncommitted changes.

    Files that the repository does not know do not count. It is None if the package was installed from a wheel, even inside
    another repository, if git is not installed, or if git refuses to read a repository of another user.
    """
    source = Path(__file__).resolve().parents[1]
    project = source / "pyproject.toml"
    if not project.is_file() or f'name = "{PACKAGES[0]}"' not in project.read_text(encoding="utf-8").splitlines():
        return None
    try:
        if Path(_git(source, "rev-parse", "--show-toplevel")).resolve() != source:
            return None
        return _git(source, "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty")  # a hash, whatever tags there are
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(folder: Path, *arguments: str) -> str:
    """What git answers in a folder.

    Raises:
        OSError: Git is not installed.
        CalledProcessError: Git refuses.
    """
    foreign = {name for name in os.environ if name.startswith("GIT_")}  # git sets GIT_DIR for its hooks
    environment = {name: value for name, value in os.environ.items() if name not in foreign}
    environment["GIT_OPTIONAL_LOCKS"] = "0"  # the user may run git at the same time
    answer = subprocess.run(
        ["git", *arguments], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=folder, env=environment, check=True
    )
    return os.fsdecode(answer.stdout).rstrip("\n")


def machine() -> dict[str, Any]:
    """Processor, number of cores, GPU (None without one) and operating system of this machine."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return dict(cpu=_cpu_name(), cores=os.cpu_count(), gpu=gpu, system=platform.system())


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
