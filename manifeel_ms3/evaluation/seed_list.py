"""A private list of initial states: seeds of evaluation episodes that are not published.

Everybody can look at the public seeds, and a policy can be fitted to them. A maintainer who compares policies keeps a private
list and evaluates on it with `manifeel eval --seeds FILE`.
"""

from pathlib import Path

from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.tasks.registry import FIRST_EVALUATION_SEED

MAX_SEED = 2**32 - 1
"""Largest seed that ManiSkill takes."""


def read_seeds(path: Path) -> list[int]:
    """The seeds in a file with one number a line; empty lines, and what follows a "#", are left out.

    The file may begin with a byte order mark, which some editors write.

    Raises:
        InvalidFileError: The file cannot be read, holds something else, no seed, a seed twice, or a seed of demonstrations.
    """
    try:
        lines = [line.partition("#")[0].strip() for line in path.read_text(encoding="utf-8-sig").splitlines()]
        seeds = [int(line) for line in lines if line]
    except (OSError, ValueError) as error:
        raise InvalidFileError(
            f"{path} is no list of seeds ({error}); give a text file with one whole number a line"
        ) from error
    if not seeds:
        raise InvalidFileError(f"{path} holds no seed; give a text file with one whole number a line")
    if twice := sorted({seed for seed in seeds if seeds.count(seed) > 1}):
        raise InvalidFileError(f"{path} holds {twice} twice; give each seed once")
    if wrong := [seed for seed in seeds if not FIRST_EVALUATION_SEED <= seed <= MAX_SEED]:
        raise InvalidFileError(
            f"{path} holds {wrong}; give seeds from {FIRST_EVALUATION_SEED} to {MAX_SEED}: demonstrations use those below"
        )
    return seeds
