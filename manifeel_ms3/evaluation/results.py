"""What was run, beside what the paper reports: `python -m manifeel_ms3.evaluation.results --results runs/matrix`."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from .claims import answers_of, find
from .claims import table as claim_table
from .markdown import markdown_table
from .paper import reported
from .protocol import LAST, collect, setup_of, success
from .result import results_in

log = logging.getLogger(__name__)
HEAD = """# Results

*Made from result files by `python -m manifeel_ms3.evaluation.results`; nothing here is typed by hand.*

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
    args.out.write_text("".join(page(results)))
    log.info("%s", args.out)
    return args.out


def page(results: list[dict[str, Any]]) -> Iterator[str]:
    """Markdown, part by part."""
    found = collect(results)
    yield HEAD.format(last=LAST)
    yield "\n## What was run\n\n"
    rows = []
    for setup, runs in sorted(found.items(), key=lambda item: tuple(map(str, vars(item[0]).values()))):
        cost, place = _cost([result for result in results if setup_of(result) == setup])
        task = f"{setup.task} `{setup.variant}`" if setup.variant else setup.task
        what = (task, setup.sensing, setup.policy, setup.encoder, setup.num_demos)
        rows.append((*what, success(runs), runs.size, cost, place))
    names = ("task", "sensing", "policy", "encoder", "demonstrations", "success", "of", "cost", "on")
    yield markdown_table(names, rows)
    yield "\n## The paper's tables\n\n"
    rows = []
    for name, setup, rate in reported():
        runs = find(setup, found)
        here = (success(runs), runs.size) if runs else ("not run", None)
        rows.append((name, setup.task, setup.obs_mode, setup.policy, setup.encoder, f"{rate:.0%}", *here))
    yield markdown_table(("table", "task", "sensing", "policy", "encoder", "paper", "here", "of"), rows)
    yield "\n## The paper's claims\n\nEach a difference of two set-ups on the same starts, with its interval of 95 % "
    yield "([how](evaluation.md)).\n\n"
    yield claim_table(answers_of(found))


def _cost(results: list[dict[str, Any]]) -> tuple[str, str]:
    """Hours of training, and on what machines."""
    longest: dict[Any, float] = {}
    machines = set()
    for result in results:
        config = result["config"]
        seed = result["training_seed"]
        longest[seed] = max(longest.get(seed, 0.0), config.get("training_seconds", 0.0))
        if trained_on := config.get("trained_on"):
            machines.add(trained_on["gpu"] or f"{trained_on['cores']} cores of an {trained_on['cpu']}")
    return f"{sum(longest.values()) / 3600:.2f} h", ", ".join(sorted(machines)) or "unknown"


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    main(tyro.cli(Args))
