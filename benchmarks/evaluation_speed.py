"""Wall-clock time of evaluations, run in turns, so that changes of the machine's speed affect all of them alike.

    git clone . ../manifeel_at_721bfa4 && git -C ../manifeel_at_721bfa4 checkout 721bfa4
    python benchmarks/evaluation_speed.py --episodes 50 --workers 2 --rounds 2 --before ../manifeel_at_721bfa4

evaluates Diffusion Policy on ball sorting three times: with this code to the time limit, with this code and
`--stop-at-success`, and with an older checkout of the repository. Times include imports, the start of all processes, and the
result file. Neither code reads the other's checkpoints. Each therefore evaluates a network of its own preset `cpu` after one
gradient step on the sample of demonstrations in its repository, on images of 256 x 256 pixels. Total times and times for each
control step are compared, since the ends of episodes and the time limits differ.
"""

import json
import os
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

TASK = "ManiFeel-BallSorting-v1"
CAMERA = "wrist"
"""Camera of the sample of demonstrations."""
RENDERED = dict(sensor_configs=dict(width=256, height=256))
"""Arguments of the task in evaluation: the size of images that policies are trained on; those of the sample are smaller."""
HERE = Path(__file__).parents[1]
"""Root of this repository."""


@dataclass
class Args:
    checkpoint: Path | None = None
    """Checkpoint folder of a policy that this code evaluates; the untrained network of the preset `cpu` if not given."""
    before: Path | None = None
    """Root of a clone with 721bfa4 checked out, which evaluates its own preset `cpu`; left out if not given."""
    episodes: int = 50
    """Number of episodes of each evaluation."""
    workers: int = 2
    """Number of processes that simulate, the same for all."""
    rounds: int = 1
    """Number of times that each evaluation is run."""


@dataclass
class Run:
    seconds: float
    steps: int
    succeeded: int


def timed(root: Path, module: str, checkpoint: Path, args: Args, *flags: str) -> Run:
    """Evaluate in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "evaluation.json"
        command = [sys.executable, "-m", module, "--checkpoint", str(checkpoint.absolute()), "--out", str(out)]
        command += ["--episodes", str(args.episodes), "--workers", str(args.workers), *flags]
        environment = os.environ | dict(PYTHONPATH=str(root.absolute()), OMP_NUM_THREADS="1")
        begin = time.perf_counter()
        done = subprocess.run(command, cwd=root, env=environment, stderr=subprocess.PIPE, text=True)
        seconds = time.perf_counter() - begin
        if done.returncode != 0:
            raise RuntimeError(f"{' '.join(command)} ended with exit code {done.returncode}:\n{done.stderr}")
        episodes = json.loads(out.read_text())["episodes"]
    steps = sum(episode.get("episode_len", episode.get("length")) for episode in episodes)
    return Run(seconds, steps, sum(episode["success_once"] for episode in episodes))


def untrained(root: Path, folder: Path) -> Path:
    """A checkpoint of the preset `cpu` after one gradient step, made by the code in a checkout with flags that both know."""
    recorded = (root / "data/sample" / TASK).glob("trajectory*.h5")
    demos = max(recorded, key=lambda path: len(path.name))  # of two files, the one with observations has the longer name
    command = [sys.executable, "baselines/diffusion_policy/train.py", "cpu", "--demos", str(demos.absolute()), "--env-id", TASK]
    command += ["--cameras", CAMERA, "--steps", "1", "--run-dir", str(folder)]
    environment = os.environ | dict(PYTHONPATH=str(root.absolute()), OMP_NUM_THREADS="1")
    subprocess.run(command, cwd=root, env=environment, check=True)
    return folder / "checkpoints/last"


def main(args: Args) -> None:
    with tempfile.TemporaryDirectory() as folder:
        now = "manifeel_ms3.evaluation.evaluate"
        rendered = ("--env-kwargs", json.dumps(RENDERED))
        here = (args.checkpoint,) if args.checkpoint else (untrained(HERE, Path(folder) / "now"), *rendered)
        commands = {"to the time limit": (HERE, now, *here), "stops at success": (HERE, now, *here, "--stop-at-success")}
        if args.before:
            old = untrained(args.before, Path(folder) / "before")
            commands["721bfa4"] = (args.before, "manifeel_ms3.evaluation.run", old, *rendered)
        runs: dict[str, list[Run]] = {name: [] for name in commands}
        for _ in range(args.rounds):
            for name, (root, module, checkpoint, *flags) in commands.items():
                runs[name].append(timed(root, module, checkpoint, args, *flags))
    table = Table("evaluation", "s", "control steps", "ms per step", "succeeded")
    for name, done in runs.items():
        seconds = np.mean([run.seconds for run in done])
        per_step = 1e3 * seconds / done[0].steps
        table.add_row(name, f"{seconds:.0f}", str(done[0].steps), f"{per_step:.1f}", str(done[0].succeeded))
    Console().print(f"{args.episodes} episodes, {args.workers} workers, {args.rounds} rounds, {os.cpu_count()} cores")
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Args))
