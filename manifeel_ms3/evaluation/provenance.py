"""The code and the machine that a result comes from."""

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

PACKAGES = ("manifeel-ms3", "mani-skill", "sapien", "torch")
"""Packages whose versions a result carries."""


def package_versions() -> dict[str, str]:
    """Installed versions of the packages that decide an outcome."""
    return {name: version(name) for name in PACKAGES}


def git_commit() -> str | None:
    """Commit of the repository that this package runs from; None where it was installed from a wheel."""
    answer = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, cwd=Path(__file__).parent, check=False
    )
    return answer.stdout.strip() or None


def machine() -> dict[str, Any]:
    """Processor, number of cores, GPU (None without one) and operating system of this machine."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return dict(cpu=_cpu_name(), cores=os.cpu_count(), gpu=gpu, system=platform.system())


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
