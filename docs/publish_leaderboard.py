"""A hook of mkdocs: the site gets the leaderboard's page and result files, to which the page of results links."""

import shutil
from pathlib import Path
from typing import Any

BOARD = Path(__file__).parents[1] / "leaderboard"
PUBLISHED = (".html", ".json")


def on_post_build(config: Any) -> None:
    """Copy the leaderboard beside the pages of the built site."""
    for path in BOARD.rglob("*"):
        if path.suffix in PUBLISHED and "checkpoints" not in path.parts:
            copy = Path(config["site_dir"]) / "leaderboard" / path.relative_to(BOARD)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
