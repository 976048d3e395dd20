"""Checkpoints: a folder with config.json and safetensors. Nothing in them is code."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from manifeel_ms3.evaluation.checkpoint_config import CheckpointError

WEIGHTS, TRAINING, CONFIG = "model.safetensors", "training.safetensors", "config.json"


def save_checkpoint(
    folder: Path, config: dict[str, Any], weights: dict[str, torch.Tensor], training: dict[str, torch.Tensor]
) -> None:
    """Write a checkpoint that appears whole or not at all.

    Args:
        config: all that is needed to build the policy, plus "step"; json.
        weights: the policy's (EMA) weights.
        training: what resuming needs besides, from `pack`.
    """
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    save_file({name: t.contiguous() for name, t in weights.items()}, partial / WEIGHTS)
    save_file({name: t.contiguous() for name, t in training.items()}, partial / TRAINING)
    (partial / CONFIG).write_text(json.dumps(config, indent=2))
    shutil.rmtree(folder, ignore_errors=True)
    partial.replace(folder)


def make_last(folder: Path) -> None:
    """Let `last`, beside a checkpoint, point to it."""
    link = folder.with_name("last.partial")
    link.unlink(missing_ok=True)
    link.symlink_to(folder.name)
    link.replace(folder.with_name("last"))


def prune(checkpoints: Path, keep: int, in_use: set[Path]) -> None:
    """Delete all checkpoints but the newest `keep` and those in use; of older ones, what only resuming needs."""
    folders = sorted(path for path in checkpoints.iterdir() if path.name.isdigit())
    for folder in folders[:-1]:
        (folder / TRAINING).unlink(missing_ok=True)
    for folder in folders[:-keep]:
        if folder not in in_use:
            shutil.rmtree(folder)


def read_tensors(path: Path) -> dict[str, torch.Tensor]:
    try:
        return load_file(path)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} cannot be read ({error}); the checkpoint is broken, use another") from error


def load_weights(module: torch.nn.Module, weights: dict[str, torch.Tensor], source: Path) -> None:
    """Load weights that must fit.

    Raises:
        CheckpointError: names or shapes differ: the checkpoint is of another architecture.
    """
    own = module.state_dict()
    wrong = [n for n in own if n not in weights or weights[n].shape != own[n].shape] + [n for n in weights if n not in own]
    if wrong:
        raise CheckpointError(
            f"{source} holds another architecture: {len(wrong)} tensors do not fit, first {wrong[0]!r}; "
            "build the policy from the checkpoint's own config.json"
        )
    module.load_state_dict(weights)


def require_same_config(saved: dict[str, Any], wanted: dict[str, Any], free: set[str], source: Path) -> None:
    """Refuse to resume a run with other settings, but for those in `free`.

    Raises:
        CheckpointError: a setting differs; all that do are named.
    """
    saved, wanted = json.loads(json.dumps(saved)), json.loads(json.dumps(wanted))
    differing = {k: (saved.get(k), v) for k, v in wanted.items() if k not in free and saved.get(k) != v}
    if differing:
        lines = ", ".join(f"{k}: {old!r} there, {new!r} now" for k, (old, new) in differing.items())
        raise CheckpointError(
            f"{source} was trained with other settings ({lines}); resume with the same, or choose another --run-dir"
        )


def pack(optimizer: torch.optim.Optimizer, model: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Optimiser state, raw weights and torch's random states as named tensors."""
    packed = {f"model.{name}": t for name, t in model.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        packed |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in state.items()}
    packed["random"] = torch.get_rng_state()
    if torch.cuda.is_available():
        packed["cuda_random"] = torch.cuda.get_rng_state()
    return packed


def unpack(packed: dict[str, torch.Tensor], optimizer: torch.optim.Optimizer, model: torch.nn.Module, source: Path) -> None:
    """Undo `pack`."""
    load_weights(model, {n.removeprefix("model."): t for n, t in packed.items() if n.startswith("model.")}, source)
    state: dict[int, dict[str, torch.Tensor]] = {}
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    for name, tensor in packed.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".", 2)
            own = parameters[int(index)]  # fused optimisers take it that moments lie in memory as their weights do
            state.setdefault(int(index), {})[key] = torch.empty_like(own).copy_(tensor) if tensor.shape == own.shape else tensor
    optimizer.load_state_dict(optimizer.state_dict() | dict(state=state))
    torch.set_rng_state(packed["random"])
    if "cuda_random" in packed and torch.cuda.is_available():
        torch.cuda.set_rng_state(packed["cuda_random"])


def as_json(config: Any) -> dict[str, Any]:
    """A dataclass as what json can hold."""
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))
