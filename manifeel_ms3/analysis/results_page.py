"""A page of all results beside those of the paper: `python -m manifeel_ms3.analysis.results_page --results runs/matrix`.

Figures are static images for the documentation, which matplotlib draws; pages that a reader explores in a browser (the report
of a run, the leaderboard) have plotly's interactive ones.
"""

import json
import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import tyro

from manifeel_ms3.command_line import missing_extras_named, run
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config
from manifeel_ms3.evaluation.result import results_in
from manifeel_ms3.files import write_text

from .claims import claims_table, find_with_one_network, results_of_claims
from .markdown import markdown_table
from .paper import reported
from .protocol import LAST, Condition, ConditionResults, collect, condition_of, difference, mean_success

log = logging.getLogger(__name__)
REFERENCES = ("MeanAction", "Untrained")
"""Names of the policies of `baselines.references`, which have learnt nothing."""
PANEL = (5.0, 3.4)
"""Width and height of a panel with learning curves, in inches."""
DPI = 130
"""Resolution of figures, in pixels per inch."""
SECONDS_PER_HOUR = 3600
HEAD = """# Results

*Made from result files by `python -m manifeel_ms3.analysis.results_page`; nothing here is typed by hand.*

Success is success at any step of an episode, with its interval of 95 %: the mean over training seeds, the last checkpoints (at
most {last}) and the evaluation episodes; "of" says how many there are of each. Cost is that of training, all seeds together.
"""


@dataclass
class Args:
    """Arguments of the page of results."""

    results: tuple[Path, ...]
    """Folders with result files, and with the logs of training if there are any."""
    out: Path = Path("docs/results.md")
    """Path of the Markdown page; its figure goes into the folder images beside it."""


def main(args: Args) -> Path:
    """Write the page, and return its path.

    A figure of learning curves that was drawn before stays on the page where the logs of training are not at hand.

    Raises:
        ResultError: There is no result, or one is broken.
    """
    results = results_in(*args.results)
    figure = args.out.parent / f"images/{args.out.stem}.png"
    has_figure = training_curves(args.results, figure) or figure.is_file()
    write_text(args.out, "".join(page(results, figure.relative_to(args.out.parent) if has_figure else None)))
    log.info("%s", args.out)
    return args.out


def training_curves(folders: tuple[Path, ...], out: Path) -> bool:
    """Draw the loss of every training run, with one panel for each task.

    Args:
        folders: Folders that are searched for logs of training.
        out: Path of the figure.

    Returns:
        Whether there is a log; nothing is drawn without one.

    Raises:
        MissingExtraError: The extra `report`, which draws, is not installed.
    """
    with missing_extras_named():
        from matplotlib.figure import Figure

    runs: dict[str, list[tuple[str, list[dict[str, float]]]]] = {}
    for path in sorted(path for folder in folders for path in folder.rglob("log.jsonl")):
        if not (path.parent / "checkpoints/last").exists():  # the run has no checkpoint yet
            continue
        config = checkpoint_config(path.parent / "checkpoints/last")
        entries = [entry for line in path.read_text().splitlines() if "loss" in (entry := json.loads(line))]
        name = f"{config['policy_name']}, {config['obs_mode']}, seed {config['seed']}"
        runs.setdefault(config["env_id"], []).append((name, entries))
    if not runs:
        return False
    fig = Figure(figsize=(PANEL[0] * len(runs), PANEL[1]), layout="constrained")
    axes = fig.subplots(1, len(runs), squeeze=False)[0]
    for ax, (task, curves) in zip(axes, runs.items(), strict=True):
        for name, entries in curves:
            ax.plot([entry["step"] for entry in entries], [entry["loss"] for entry in entries], label=name, lw=1)
        ax.set(title=task, xlabel="gradient step", ylabel="loss", yscale="log")
        ax.legend(fontsize=7)
    out.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(out, dpi=DPI)
    return True


def page(results: list[dict[str, Any]], curves: Path | None = None) -> Iterator[str]:
    """The Markdown page, part by part.

    Args:
        results: Contents of result files.
        curves: Path of the figure with learning curves, relative to the page; no figure if not given.
    """
    found = collect(results)
    yield HEAD.format(last=LAST)
    yield "\n## What was run\n\n"
    yield _table_of_conditions(found, results)
    if curves:
        yield f"\n![Loss in training over gradient steps]({curves})\n"
    if rows := list(_gains_over_references(found)):
        yield "\n## What learning gained\n\nThe gain over policies that have learnt nothing, on the same initial states: the "
        yield "network before training, and the mean action of the demonstrations (`baselines/references.py`).\n\n"
        yield markdown_table(("task", "sensing", "policy", "over", "gain", "p"), rows)
    yield "\n## The paper's tables\n\nThe paper's networks are ResNet-18; where another one was run here, \"network\" names "
    yield "it.\n\n"
    yield _table_of_the_paper(found)
    yield "\n## The paper's claims\n\nEach claim is a difference of two conditions on the same initial states, with its "
    yield "interval of 95 % ([how](evaluation.md)).\n\n"
    yield claims_table(results_of_claims(found))


def _table_of_conditions(found: dict[Condition, ConditionResults], results: list[dict[str, Any]]) -> str:
    rows = []
    for condition, here in _sorted(found):
        cost, machines = _cost([result for result in results if condition_of(result) == condition])
        what = (_task(condition), condition.sensing, condition.policy, condition.network, condition.encoder)
        rows.append((*what, condition.num_demos, mean_success(here), here.size, cost, machines))
    names = ("task", "sensing", "policy", "network", "TacRGB encoder", "demonstrations", "success", "of", "cost", "on")
    return markdown_table(names, rows)


def _table_of_the_paper(found: dict[Condition, ConditionResults]) -> str:
    rows = []
    for table, condition, rate in reported():
        results, network = find_with_one_network([condition], found)
        here = (mean_success(*results), results[0].size, network) if results else ("not run", None, None)
        rows.append((table, condition.task, condition.obs_mode, condition.policy, condition.encoder, f"{rate:.0%}", *here))
    return markdown_table(("table", "task", "sensing", "policy", "TacRGB encoder", "paper", "here", "of", "network"), rows)


def _sorted(found: dict[Condition, ConditionResults]) -> list[tuple[Condition, ConditionResults]]:
    return sorted(found.items(), key=lambda item: tuple(map(str, vars(item[0]).values())))


def _task(condition: Condition) -> str:
    return f"{condition.task} `{condition.variant}`" if condition.variant else condition.task


def _gains_over_references(found: dict[Condition, ConditionResults]) -> Iterator[tuple[str, ...]]:
    for (condition, results), (other, learnt_nothing) in product(_sorted(found), repeat=2):
        same_task = (condition.env_id, condition.variant) == (other.env_id, other.variant)
        comparable = same_task and other.obs_mode in ("none", condition.obs_mode)
        if comparable and other.policy in REFERENCES and condition.policy not in REFERENCES:
            gain, p_value = difference(results, learnt_nothing)
            yield _task(condition), condition.sensing, condition.policy, other.policy, gain.signed, f"{p_value:.1g}"


def _cost(results: list[dict[str, Any]]) -> tuple[str | None, str | None]:
    """Hours of training and the machines that trained, as text; None for a policy that was not trained."""
    longest: dict[Any, float] = {}
    machines = set()
    for result in results:
        config = result["config"]
        seed = result["training_seed"]
        longest[seed] = max(longest.get(seed, 0.0), config.get("training_seconds", 0.0))
        if trained_on := config.get("trained_on"):
            machines.add(trained_on["gpu"] or f"{trained_on['cores']} cores of an {trained_on['cpu']}")
    hours = sum(longest.values()) / SECONDS_PER_HOUR
    return f"{hours:.2f} h" if hours else None, ", ".join(sorted(machines)) or None


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
