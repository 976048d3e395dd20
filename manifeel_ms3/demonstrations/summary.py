"""Summarize a trajectory file in the terminal: `manifeel summary trajectory.h5`."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tyro
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from manifeel_ms3.arguments import require_not_negative
from manifeel_ms3.command_line import as_typed, run
from manifeel_ms3.text import one_line

from .formats.maniskill_h5 import group_of, open_trajectories, origins, read_header, task_of, versions_of

BARS = " ▁▂▃▄▅▆▇█"
"""Characters of a sparkline, from the lowest level to the highest: Unicode's eighths of a block."""
WIDTH = 28
"""Number of characters of a sparkline and of the longest bar of a histogram; set once, not tuned."""
NUM_SHOWN = 12
"""Number of episodes, and of arrays, that are listed one by one; set once, not tuned."""
LEAST_TOP = 1e-9
"""Smallest value that the highest bar of a sparkline may stand for, so that nothing is divided by 0."""
FORCE_EDGES = (0, 0.5, 1, 2, 5, 10, 20, 40, 60, np.inf)
"""Edges of the histogram's bins in N, in steps of about 2; demonstrations stay under 60 N."""


@dataclass
class Args:
    """Arguments of the command."""

    file: tyro.conf.Positional[Path]
    """Path of the trajectory file; it may be the file of another program in ManiSkill's format."""
    episodes: int = NUM_SHOWN
    """Number of episodes to list one by one."""


def sparkline(values: np.ndarray, top: float) -> str:
    """Values (T,) as a row of bars, each as high as the largest value of its stretch; the highest bar stands for `top`."""
    if len(values) == 0:
        return ""
    stretches = np.array_split(values, min(WIDTH, len(values)))
    levels = [round(min(max(stretch.max() / max(top, LEAST_TOP), 0), 1) * (len(BARS) - 1)) for stretch in stretches]
    return "".join(BARS[level] for level in levels)


def main(args: Args) -> None:
    """Print the summary.

    Raises:
        InvalidArgumentError: The number of episodes to list is negative.
        DemonstrationError: The file is missing or broken.
    """
    require_not_negative(episodes=args.episodes)
    Console().print(summary(args.file, args.episodes))


def summary(path: Path, num_shown: int = NUM_SHOWN) -> Group:
    """Tables of a trajectory file: the file as a whole, contact forces, episodes, and the sizes of its arrays.

    Args:
        path: Trajectory file.
        num_shown: Number of episodes to list one by one.

    Raises:
        DemonstrationError: The file is missing or broken.
    """
    header = read_header(path)
    episodes = header["episodes"]
    with open_trajectories(path) as file:
        groups = [group_of(file, episode) for episode in episodes]
        forces = [group["contact_force"][()] for group in groups if "contact_force" in group]  # not in other programs' files
        sizes: dict[str, int] = {}

        def count(name: str, item: h5py.HLObject) -> None:
            if isinstance(item, h5py.Dataset):
                part = name.partition("/")[2]
                sizes[part] = sizes.get(part, 0) + item.id.get_storage_size()

        file.visititems(count)
    known = len(forces) == len(episodes)
    tables = [_file_table(path, header), _episode_table(episodes[:num_shown], forces if known else None)]
    tables[1:1] = [_force_table(forces)] if known else []
    return Group(*tables, _size_table(sizes, len(episodes)))


def _file_table(path: Path, header: dict) -> Table:
    episodes, env = header["episodes"], header["env_info"]
    lengths = np.array([episode["elapsed_steps"] for episode in episodes] or [0])
    successes = sum(bool(episode["success"]) for episode in episodes)
    table = Table(title=_shown(path), show_header=False)
    table.add_row("task", _shown(f"{task_of(header)}, revision {header.get('revision', 'not known')}"))
    table.add_row("observations", _shown(env["env_kwargs"].get("obs_mode")))
    table.add_row("source", _shown(", ".join(map(str, filter(None, origins(header, "source_type")))) or "not known"))
    versions = versions_of(header) or {}
    recorded_with = ", ".join(f"{name} {number}" for name, number in versions.items())
    table.add_row("recorded with", _shown(recorded_with or "not known"))
    table.add_row(
        "episodes", f"{len(episodes)}, {successes} successes, {len(header.get('failed_seeds', []))} seeds that failed"
    )
    table.add_row("steps", f"{lengths.mean():.0f} on average, {lengths.min()} to {lengths.max()}, {lengths.sum()} in all")
    table.add_row(
        "size", f"{path.stat().st_size / 1e6:.2f} MB, {path.stat().st_size / 1e6 / max(len(episodes), 1):.2f} per episode"
    )
    return table


def _force_table(forces: list[np.ndarray]) -> Table:
    """Numbers of steps by the contact force, which is that of the hand on the held part."""
    table = Table("contact force, N", "steps", "", title="contact forces")
    everything = np.concatenate(forces) if forces else np.zeros(0)
    counts, _ = np.histogram(everything, FORCE_EDGES)
    for low, high, number in zip(FORCE_EDGES, FORCE_EDGES[1:], counts, strict=False):
        bar = "█" * round(WIDTH * number / max(counts.max(), 1))
        table.add_row(f"{low:g} to {high:g}" if np.isfinite(high) else f"over {low:g}", str(number), bar)
    return table


def _episode_table(episodes: list[dict], forces: list[np.ndarray] | None) -> Table:
    """A row for each episode, with its contact forces where they are known."""
    table = Table("episode", "seed", "steps", "success", title="episodes")
    for column in () if forces is None else ("peak, N", "contact force over time"):
        table.add_column(column)
    top = max((force.max(initial=0) for force in forces or []), default=0.0)
    for i, episode in enumerate(episodes):
        cells = [_shown(episode[name]) for name in ("episode_id", "episode_seed", "elapsed_steps")]
        measured = [] if forces is None else [f"{forces[i].max(initial=0):.1f}", sparkline(forces[i], top)]
        table.add_row(*cells, "yes" if episode["success"] else "no", *measured)
    return table


def _size_table(sizes: dict[str, int], episodes: int) -> Table:
    table = Table("array", "MB", "kB per episode", title="sizes of the arrays")
    for name, size in sorted(sizes.items(), key=lambda item: -item[1])[:NUM_SHOWN]:
        table.add_row(_shown(name), f"{size / 1e6:.2f}", f"{size / 1e3 / max(episodes, 1):.1f}")
    return table


def _shown(text: Any) -> Text:
    """A text of the file in one line, without colours, links or other codes that a terminal would obey."""
    return Text(one_line(str(text)))


def next_step(args: Args, _answer: None) -> str:
    """What one can do with the file."""
    check, film = as_typed("manifeel", "validate", args.file), as_typed("manifeel", "film", args.file, "--out", "FILE.mp4")
    return f"{check} checks the file, {film} shows an episode"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
