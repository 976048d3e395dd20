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
    """Commit of this package's own repository.

    It is None if the package was installed from a wheel, even inside another repository, if git is not installed, or if git
    refuses to read a repository of another user.
    """
    source = Path(__file__).resolve().parents[1]
    project = source / "pyproject.toml"
    if not project.is_file() or f'name = "{PACKAGES[0]}"' not in project.read_text(encoding="utf-8").splitlines():
        return None
    foreign = {name for name in os.environ if name.startswith("GIT_")}  # git sets GIT_DIR for its hooks
    environment = {name: value for name, value in os.environ.items() if name not in foreign}
    command = ["git", "rev-parse", "--show-toplevel", "HEAD"]
    try:
        answer = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=source, env=environment, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    top, commit = os.fsdecode(answer.stdout).splitlines()
    return commit if Path(top).resolve() == source else None


def machine() -> dict[str, Any]:
    """Processor, number of cores, GPU (None without one) and operating system of this machine."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return dict(cpu=_cpu_name(), cores=os.cpu_count(), gpu=gpu, system=platform.system())


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
