"""The configuration that a checkpoint folder holds."""

import json
from pathlib import Path
from typing import Any

from manifeel_ms3.errors import InvalidFileError


class CheckpointError(InvalidFileError):
    """A checkpoint folder is missing, broken or of an older version."""


def checkpoint_config(checkpoint: Path) -> dict[str, Any]:
    """The content of config.json in a checkpoint folder.

    Raises:
        CheckpointError: There is no config.json, or it is broken.
    """
    path = Path(checkpoint) / "config.json"
    if not path.is_file():
        raise CheckpointError(
            f"{checkpoint} is not a checkpoint: it has no config.json; give a folder like runs/<name>/checkpoints/last"
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
