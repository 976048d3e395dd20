"""What a checkpoint says of itself."""

import json
from pathlib import Path
from typing import Any


class CheckpointError(ValueError):
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
        return json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise CheckpointError(f"{path} is not json ({error}); the checkpoint is broken, use another") from error
