"""What stages cost: what those like them took on this machine, or else figures of another one, scaled."""

import importlib
import json
import math
import os
import socket
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from ..provenance import machine
from .study import Stage
from .work import DONE, FAILED, STARTED

# on one core of an AMD EPYC: seconds a step of simulation, with observations; a picture, there and back; a U-Net's batch
REFERENCE_CONVOLUTION = 0.02
STEP = 0.045
PICTURE = {"small_cnn": 0.003, "resnet18": 0.15, "unit": 0.6, "t3": 0.45, "sparsh": 0.45, "anytouch": 1.6}
UNET = {"paper": 2.5, "cpu": 0.1}
EQUIVARIANT = 4.0  # times, about
LENGTH = {  # steps of a demonstration, and of the longest episode
    "ManiFeel-NutBoltAssembly-v1": (400, 500),
    "ManiFeel-BulbInstallation-v1": (410, 500),
    "ManiFeel-GearAssembly-v1": (106, 300),
    "ManiFeel-ObjectSearch-v1": (111, 400),
}
USUAL_LENGTH = (85, 300)


@dataclass(frozen=True)
class Estimate:
    seconds: float
    """of wall clock, with the resources asked for"""
    source: str


def read(path: Path) -> dict[str, Any]:
    """A note that a stage has left; {} if there is none."""
    return json.loads(path.read_text()) if path.is_file() else {}


def is_running(folder: Path) -> bool:
    """Whether a worker has begun and not ended; one of this machine must be alive."""
    started = read(folder / STARTED)
    if not started or (folder / DONE).is_file() or (folder / FAILED).is_file():
        return False
    return started["host"] != socket.gethostname() or Path(f"/proc/{started['pid']}").exists() or os.name != "posix"


def estimate(stage: Stage, root: Path, workers: int = 1) -> Estimate:
    """How long a stage will take, with so many processes that simulate."""
    units = _units(stage) / (1 if stage.kind == "train" else workers)
    took = [
        note["seconds"] / max(note["units"], 1) * (1 if stage.kind == "train" else note["workers"])
        for note in _done(root)
        if _alike(note["settings"], stage)
    ]
    if took:
        return Estimate(float(np.median(took)) * units, "runs here")
    return Estimate(_reference(stage) * _slowness() * units, "a guess")


def _done(root: Path) -> list[dict[str, Any]]:
    here = machine()
    notes = [_note(path, path.stat().st_mtime) for path in root.glob(f"*/*/{DONE}")]
    return [note for note in notes if note["machine"] == here]


@cache
def _note(path: Path, _changed: float) -> dict[str, Any]:
    return read(path)


def _alike(settings: dict[str, Any], stage: Stage) -> bool:
    """Whether the work was the same but for seeds, code and amount."""
    return _work(settings) == _work(stage.settings)


def _work(settings: dict[str, Any]) -> dict[str, Any]:
    ignored = {"seed", "env-id", "steps", "keep", "save-every", "num-demos"}
    flags = {name: value for name, value in settings.get("flags", {}).items() if name not in ignored}
    rest = {name: value for name, value in settings.items() if name not in ("code", "num", "flags", "episodes", "checkpoints")}
    return rest | dict(flags=flags)


def _units(stage: Stage) -> int:
    """Demonstrations, gradient steps, episodes."""
    settings = stage.settings
    if stage.kind == "record":
        return settings["num"]
    if stage.kind == "evaluate":
        return settings["episodes"] * settings["checkpoints"]
    args, (record,) = _training(stage), stage.needs
    if args.steps:
        return args.steps
    demos = args.num_demos or record.settings["num"]
    return round(50_000 / demos) * math.ceil(demos * _length(record)[0] / args.batch_size)


def _training(stage: Stage) -> Any:
    presets = importlib.import_module(f"baselines.{stage.settings['policy']}.train").PRESETS
    return replace(
        presets[stage.settings["preset"]][1],
        **{
            name.replace("-", "_"): value
            for name, value in stage.settings["flags"].items()
            if name in ("steps", "batch-size", "num-demos")
        },
    )


def _length(record: Stage) -> tuple[int, int]:
    return LENGTH.get(record.settings["env_id"], USUAL_LENGTH)


def _reference(stage: Stage) -> float:
    """Seconds a unit on the reference machine."""
    if stage.kind == "record":
        return STEP * _length(stage)[0]
    if stage.kind == "evaluate":
        return STEP * _length(stage.needs[0].needs[0])[1]
    args, settings = _training(stage), stage.settings
    modes = settings["flags"]["obs-mode"].split("+")
    encoder = args.policy.encoder
    pictures = [PICTURE.get(encoder.image, 0.15)] * ("rgb" in modes)
    pictures += [PICTURE.get(settings["flags"].get("policy.encoder.tacrgb", encoder.tacrgb), 0.5)] * ("tacrgb" in modes)
    each = sum(pictures) * args.batch_size * args.policy.obs_horizon + UNET.get(settings["preset"], UNET["paper"])
    return each * (EQUIVARIANT if settings["policy"].startswith("equivariant") else 1)


@cache
def _slowness() -> float:
    """Of this machine, against the reference: by a convolution on the device that trains."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    image, weight = torch.randn(16, 64, 64, 64, device=device), torch.randn(64, 64, 3, 3, device=device)
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        F.conv2d(image, weight, padding=1).sum().item()
        times.append(time.perf_counter() - begin)
    return min(times) / REFERENCE_CONVOLUTION
