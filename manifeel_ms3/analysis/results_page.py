"""What was run, beside what the paper reports: `python -m manifeel_ms3.analysis.results_page --results runs/matrix`."""

import json
import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import tyro

from manifeel_ms3.command_line import run
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config
from manifeel_ms3.evaluation.result import results_in
from manifeel_ms3.files import write_text

from .claims import answers_of, find_alike
from .claims import table as claim_table
from .markdown import markdown_table
from .paper import reported
from .protocol import LAST, Runs, Setup, collect, difference, setup_of, success

log = logging.getLogger(__name__)
REFERENCES = ("MeanAction", "Untrained")  # of baselines.references
HEAD = """# Results

*Made from result files by `python -m manifeel_ms3.analysis.results_page`; nothing here is typed by hand.*

Success at any step, with its interval of 95 %: mean over training seeds, the last checkpoints (at most {last}) and starts; how
many of each stands under "of". Cost is training alone, all seeds together.
"""


@dataclass
class Args:
    results: tuple[Path, ...]
    """folders with result files"""
    out: Path = Path("docs/results.md")


def main(args: Args) -> Path:
    """Write the page.

    Raises:
        ResultError: there is no result, or one is broken.
    """
    results = results_in(*args.results)
    picture = args.out.parent / f"images/{args.out.stem}.png"
    curves = training_curves(args.results, picture)
    write_text(args.out, "".join(page(results, picture.relative_to(args.out.parent) if curves else None)))
    log.info("%s", args.out)
    return args.out


def training_curves(folders: tuple[Path, ...], out: Path) -> bool:
    """Draw the loss of every training run under some folders, a panel a task; False if there is none."""
    from matplotlib.figure import Figure

    runs: dict[str, list[tuple[str, list[dict[str, float]]]]] = {}
    for path in sorted(path for folder in folders for path in folder.rglob("log.jsonl")):
        if not (path.parent / "checkpoints/last").exists():  # it has only begun
            continue
        config = checkpoint_config(path.parent / "checkpoints/last")
        entries = [entry for line in path.read_text().splitlines() if "loss" in (entry := json.loads(line))]
        name = f"{config['policy_name']}, {config['obs_mode']}, seed {config['seed']}"
        runs.setdefault(config["env_id"], []).append((name, entries))
    if not runs:
        return False
    fig = Figure(figsize=(5 * len(runs), 3.4), layout="constrained")
    axes = fig.subplots(1, len(runs), squeeze=False)[0]
    for ax, (task, curves) in zip(axes, runs.items(), strict=True):
        for name, entries in curves:
            ax.plot([entry["step"] for entry in entries], [entry["loss"] for entry in entries], label=name, lw=1)
        ax.set(title=task, xlabel="gradient step", ylabel="loss", yscale="log")
        ax.legend(fontsize=7)
    out.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(out, dpi=130)
    return True


def page(results: list[dict[str, Any]], curves: Path | None = None) -> Iterator[str]:
    """Markdown, part by part; `curves`: the picture of training, relative to the page."""
    found = collect(results)
    yield HEAD.format(last=LAST)
    yield "\n## What was run\n\n"
    rows = []
    for setup, runs in _sorted(found):
        cost, place = _cost([result for result in results if setup_of(result) == setup])
        what = (_task(setup), setup.sensing, setup.policy, setup.network, setup.encoder, setup.num_demos)
        rows.append((*what, success(runs), runs.size, cost, place))
    names = ("task", "sensing", "policy", "network", "TacRGB encoder", "demonstrations", "success", "of", "cost", "on")
    yield markdown_table(names, rows)
    if curves:
        yield f"\n![losses in training]({curves})\n"
    if rows := list(_gains_over_references(found)):
        yield "\n## What learning gained\n\nOver policies that learnt nothing, on the same starts: the network before "
        yield "training, and the mean action of the demonstrations (`baselines/references.py`).\n\n"
        yield markdown_table(("task", "sensing", "policy", "over", "gain", "p"), rows)
    yield "\n## The paper's tables\n\nThe paper's networks are ResNet-18; where another was run here, \"network\" names it.\n\n"
    rows = []
    for name, setup, rate in reported():
        runs, network = find_alike([setup], found)
        here = (success(*runs), runs[0].size, network) if runs else ("not run", None, None)
        rows.append((name, setup.task, setup.obs_mode, setup.policy, setup.encoder, f"{rate:.0%}", *here))
    yield markdown_table(("table", "task", "sensing", "policy", "TacRGB encoder", "paper", "here", "of", "network"), rows)
    yield "\n## The paper's claims\n\nEach a difference of two set-ups on the same starts, with its interval of 95 % "
    yield "([how](evaluation.md)).\n\n"
    yield claim_table(answers_of(found))


def _sorted(found: dict[Setup, Runs]) -> list[tuple[Setup, Runs]]:
    return sorted(found.items(), key=lambda item: tuple(map(str, vars(item[0]).values())))


def _task(setup: Setup) -> str:
    return f"{setup.task} `{setup.variant}`" if setup.variant else setup.task


def _gains_over_references(found: dict[Setup, Runs]) -> Iterator[tuple]:
    for (setup, runs), (other, learnt_nothing) in product(_sorted(found), repeat=2):
        alike = (setup.env_id, setup.variant) == (other.env_id, other.variant) and other.obs_mode in ("none", setup.obs_mode)
        if alike and other.policy in REFERENCES and setup.policy not in REFERENCES:
            gain, p_value = difference(runs, learnt_nothing)
            yield _task(setup), setup.sensing, setup.policy, other.policy, gain.signed, f"{p_value:.1g}"


def _cost(results: list[dict[str, Any]]) -> tuple[str | None, str | None]:
    """Hours of training, and on what machines; None for what was not trained."""
    longest: dict[Any, float] = {}
    machines = set()
    for result in results:
        config = result["config"]
        seed = result["training_seed"]
        longest[seed] = max(longest.get(seed, 0.0), config.get("training_seconds", 0.0))
        if trained_on := config.get("trained_on"):
            machines.add(trained_on["gpu"] or f"{trained_on['cores']} cores of an {trained_on['cpu']}")
    hours = sum(longest.values()) / 3600
    return f"{hours:.2f} h" if hours else None, ", ".join(sorted(machines)) or None


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
