"""What a checkpoint says of itself."""

import json
from pathlib import Path
from typing import Any

from manifeel_ms3.errors import InvalidFileError


class CheckpointError(InvalidFileError):
    """A checkpoint that cannot be used as asked."""


def checkpoint_config(checkpoint: Path) -> dict[str, Any]:
    """config.json of a checkpoint folder.

    Raises:
        CheckpointError: there is none, or it is broken.
    """
    path = Path(checkpoint) / "config.json"
    if not path.is_file():
        raise CheckpointError(
            f"{checkpoint} is not a checkpoint: it has no config.json; give a folder like runs/<name>/checkpoints/last"
        )
    try:
        config = json.loads(path.read_text())
    except ValueError as error:
        raise CheckpointError(f"{path} is not json ({error}); the checkpoint is broken, use another") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"{path} holds {type(config).__name__}, not a config; the checkpoint is broken, use another")
    return config
