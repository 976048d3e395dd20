"""The machine that a result comes from."""

import os
import platform
from pathlib import Path
from typing import Any

import torch


def machine() -> dict[str, Any]:
    """What computes here."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return dict(cpu=_cpu_name(), cores=os.cpu_count(), gpu=gpu, system=platform.system())


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
