"""Wall-clock time of evaluations, in turns, so that a change of the machine's speed meets all of them alike.

    python benchmarks/evaluation_speed.py --checkpoint runs/ball/checkpoints/last --episodes 50 --workers 2 --rounds 2 \
        --before ../manifeel_at_721bfa4

evaluates a checkpoint with this code, once by the present rule and once with `--stop-at-success`, and with an older checkout
of the repository, as its users would: with imports, the start of all processes, and the result file. The older code gets the
same weights; names in its configuration are translated to those of 721bfa4. Compared are seconds, and seconds for each
control step, since the rules and the time limits differ.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

OLD_NAMES = dict(down_dims="channels", kernel_size="kernel", n_groups="groups", diffusion_step_embed_dim="step_embedding")
"""Settings of the U-Net, and what 721bfa4 calls them."""
OLD_CLASSES = dict(diffusion_policy="baselines.diffusion_policy.policy:DiffusionPolicy")
"""Policies by their registered names, and what a checkpoint of 721bfa4 says instead."""
HERE = Path(__file__).parents[1]


@dataclass
class Args:
    checkpoint: Path
    """Checkpoint folder of a Diffusion Policy."""
    before: Path | None = None
    """Root of a checkout of 721bfa4, such as `git worktree add ../manifeel_at_721bfa4 721bfa4` makes; left out if not given."""
    episodes: int = 50
    """Number of episodes of each evaluation."""
    workers: int = 2
    """Number of processes that simulate, the same for all."""
    rounds: int = 1
    """Number of times that each evaluation is run."""


@dataclass
class Run:
    seconds: float
    cpu_seconds: float
    steps: int
    succeeded: int


def timed(root: Path, module: str, checkpoint: Path, args: Args, *flags: str) -> Run:
    """Evaluate in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "evaluation.json"
        command = [sys.executable, "-m", module, "--checkpoint", str(checkpoint.absolute()), "--out", str(out)]
        command += ["--episodes", str(args.episodes), "--workers", str(args.workers), *flags]
        environment = os.environ | dict(PYTHONPATH=str(root.absolute()), OMP_NUM_THREADS="1")
        before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run(command, cwd=root, env=environment, check=True, stderr=subprocess.DEVNULL)
        seconds, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
        episodes = json.loads(out.read_text())["episodes"]
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    steps = sum(episode.get("episode_len", episode.get("length")) for episode in episodes)
    return Run(seconds, used, steps, sum(episode["success_once"] for episode in episodes))


def for_721bfa4(checkpoint: Path, folder: Path) -> Path:
    """The checkpoint as 721bfa4 reads it."""
    config = json.loads((checkpoint / "config.json").read_text())
    policy = {OLD_NAMES.get(name, name): value for name, value in config["policy"].items()}
    old = dict(kind="baselines.common.agent:PolicyAgent", policy_class=OLD_CLASSES[config["policy_name"]], policy=policy)
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps(config | old))
    shutil.copy(checkpoint / "model.safetensors", folder)
    return folder


def main(args: Args) -> None:
    with tempfile.TemporaryDirectory() as folder:
        now = "manifeel_ms3.evaluation.evaluate"
        commands = {
            "to the time limit": (HERE, now, args.checkpoint),
            "stops at success": (HERE, now, args.checkpoint, "--stop-at-success"),
        }
        if args.before:
            old = for_721bfa4(args.checkpoint, Path(folder) / "checkpoint")
            commands["721bfa4"] = (args.before, "manifeel_ms3.evaluation.run", old)
        runs: dict[str, list[Run]] = {name: [] for name in commands}
        for _ in range(args.rounds):
            for name, (root, module, checkpoint, *flags) in commands.items():
                runs[name].append(timed(root, module, checkpoint, args, *flags))
    table = Table("evaluation", "s", "CPU s", "control steps", "ms per step", "succeeded")
    for name, done in runs.items():
        seconds, cpu = np.mean([run.seconds for run in done]), np.mean([run.cpu_seconds for run in done])
        per_step = 1e3 * seconds / done[0].steps
        table.add_row(name, f"{seconds:.0f}", f"{cpu:.0f}", str(done[0].steps), f"{per_step:.1f}", str(done[0].succeeded))
    Console().print(f"{args.episodes} episodes, {args.workers} workers, {args.rounds} rounds, {os.cpu_count()} cores")
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Args))
