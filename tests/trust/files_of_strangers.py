"""Files that do harm, for the tests of the readers: copies of the sample, a secret beside them, and a class that runs code."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.sample import observed_sample
from tests.tasks_and_marks import PEG

REPOSITORY = Path(__file__).parents[2]
SAMPLE = observed_sample(PEG)
LEROBOT = REPOSITORY / "tests/demonstrations/lerobot"
SECRET = b"TOP SECRET TEXT OF ANOTHER FILE."
EXECUTED = "import pathlib; pathlib.Path('executed').touch()\n"


class Gadget:
    """An object that runs a command when it is unpickled."""

    def __reduce__(self):
        return os.system, ("touch executed",)


def rewrite_json(path: Path, change: Callable[[Any], object]) -> None:
    """Let a function change the content of a json file."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
