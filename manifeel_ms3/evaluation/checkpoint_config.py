"""The configuration that a checkpoint folder holds, and the hash of its files."""

import copy
import hashlib
import json
from pathlib import Path
from typing import Any

from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.files import file_hash

WEIGHTS, CONFIG = "model.safetensors", "config.json"
"""Files of a checkpoint that a policy is loaded from: its weights and its settings."""
TRAINING_STATE = "training.safetensors"
"""File of a checkpoint that only training reads; it is deleted from older checkpoints, and hashes leave it out."""
TRAINING_LOSS = "losses/total_loss"
"""Name of the training loss in log.jsonl, the log beside the checkpoints."""

IMPLIED = {
    "num_processes": 1,
    "policy.action_form": "delta",
    "policy.tacrgb_scale": "colour",
    "policy.touch_noise": 0.0,
    "policy.encoder.tactile_crop": 0,
}
"""Settings that configurations of older versions lack, with the values that they count as having. Dots join nested names."""


class CheckpointError(InvalidFileError):
    """A checkpoint folder is missing, broken or of an older version."""


def checkpoint_config(checkpoint: Path) -> dict[str, Any]:
    """The content of config.json in a checkpoint folder.

    Raises:
        CheckpointError: There is no config.json, or it is broken.
    """
    path = Path(checkpoint) / CONFIG
    if not path.is_file():
        raise CheckpointError(
            f"{checkpoint} is not a checkpoint: it has no {CONFIG}; give a folder like runs/<name>/checkpoints/last"
        )
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} is not json ({error}); the checkpoint is broken, use another one") from error
    if not isinstance(config, dict):
        raise CheckpointError(
            f"{path} holds a {type(config).__name__} instead of an object; the checkpoint is broken, use another one"
        )
    return config


def with_implied(config: dict[str, Any]) -> dict[str, Any]:
    """A configuration with the settings that it lacks because it is older than they are."""
    complete = copy.deepcopy(config)
    for name, value in IMPLIED.items():
        *groups, last = name.split(".")
        entries: Any = complete
        for group in groups:
            entries = entries.get(group) if isinstance(entries, dict) else None
        if isinstance(entries, dict):
            entries.setdefault(last, value)
    return complete


def samples_per_step(config: dict[str, Any]) -> int | None:
    """Number of samples in a gradient step of a training run, over all its processes.

    Args:
        config: Configuration of the policy.

    Returns:
        None if the configuration does not give them as whole numbers of at least 1.
    """
    of_each, processes = config.get("batch_size"), with_implied(config)["num_processes"]
    are_counts = all(type(number) is int and number > 0 for number in (of_each, processes))
    return of_each * processes if are_counts else None  # pyright: ignore[reportOptionalOperand]


def hash_of_all_files(checkpoint: Path) -> str:
    """SHA-256 over the names and contents of all files that a policy is loaded from.

    Raises:
        CheckpointError: A file cannot be read.
    """
    folder, digest = Path(checkpoint), hashlib.sha256()
    try:
        for path in sorted(path for path in folder.rglob("*") if path.is_file() and path.name != TRAINING_STATE):
            digest.update(f"{file_hash(path)}  {path.relative_to(folder).as_posix()}\n".encode(errors="surrogateescape"))
    except OSError as error:
        raise CheckpointError(f"{checkpoint} cannot be read ({error}); use another checkpoint") from error
    return digest.hexdigest()


def published_hash(checkpoint: Path) -> str:
    """The published hash of a checkpoint, which `cat model.safetensors config.json | sha256sum` prints, too.

    Raises:
        CheckpointError: One of the two files is missing, or cannot be read.
    """
    try:
        return file_hash(checkpoint / WEIGHTS, checkpoint / CONFIG)
    except OSError as error:
        raise CheckpointError(f"{checkpoint} cannot be hashed ({error}); give a folder with {WEIGHTS} and {CONFIG}") from error
