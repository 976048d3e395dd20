"""A page of all results beside those of the paper: `manifeel results --results runs/study`.

Figures are static images for the documentation, which matplotlib draws; pages that a reader explores in a browser (the report
of a run, the leaderboard) have plotly's interactive ones.
"""

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any
from urllib.parse import quote

import tyro

from manifeel_ms3.arguments import require_file
from manifeel_ms3.command_line import missing_extras_named, run
from manifeel_ms3.evaluation.checkpoint_config import TRAINING_LOSS, checkpoint_config
from manifeel_ms3.evaluation.floors import POLICIES, floors_of
from manifeel_ms3.evaluation.result import ResultError, results_in
from manifeel_ms3.files import read_json_lines, write_text
from manifeel_ms3.paths import CHECKPOINTS, LAST_LINK
from manifeel_ms3.tasks.registry import all_tasks

from .claims import claims_page, results_of_claims
from .condition import Condition, condition_of
from .episode_endings import census_table
from .estimates import difference, p_text
from .figures import save_figure
from .gentle_success import draw_success_under_force
from .information_audit import audited
from .markdown import in_words, markdown_table, shown
from .matching import Found
from .paper_comparison import runtime_table, similarity_table
from .paper_tables import Files, draw_sensing_by_task, tables_of_the_paper
from .presets import FULLEST
from .protocol import FEWEST_EPISODES, FEWEST_STEPS, LAST, ConditionResults, collect, in_order_of_seeds, of_the_protocol
from .rank_agreement import rank_table
from .run_table import in_order, table_of_runs, task_with_revision
from .success_curves import DPI, PANEL, write_curves
from .touch_gain import touch_gains

REFERENCES = ("MeanAction", "Untrained")
"""Names of the policies of `baselines.references`, which have learnt nothing."""
IMAGES = "images"
"""Name of the folder beside the page that holds its figures."""
LEGEND_SIZE = 7
"""Size of the letters in the legend of the losses, in points."""
HEAD = """# Results

*Made from result files by `manifeel results`; nothing here is written by hand.*

An episode is a success if the task was solved at any step. A rate is the mean over training seeds, the last checkpoints (at
most {last}) and the evaluation episodes, with its 95 % interval over training seeds and initial states, or over initial
states alone where there is one seed; "of" gives the number of each. "Std" is the standard deviation over training seeds. "At
the end" is the share of the episodes in which the task is solved at the last step, too. It is often lower: demonstrations end
at the first success, so that policies hardly see what comes after it. "Gentle success" counts the episodes that succeed before
the contact force exceeds the task's limit, which is given in newtons ([how it is set](evaluation.md#what-is-measured)).
"Floor" is the highest success of policies that have learnt nothing, where it was measured on this revision of the task. "By
the paper's threshold" is the success by the threshold of the paper's public code ([where it is known](tasks.md)). It is less
strict in nearly every episode, and enters no comparison; older results lack it, so that a row may have it for fewer seeds than
its success. "TacRGB encoder" is the network for tactile images: `fine_cnn` is the small one of the preset `cpu`, trained from
scratch. "Settings" names the preset of the policy and what differs from it, and "id" is a hash of everything that defines the
condition. Presets were chosen by trials on these same initial states, mostly with one training seed, which is the first of
those here ([trials](trials.md)): rates on other states may be lower. "Cost" is the time of training, summed over the seeds,
and "on" the machine. It is the time on the clock, so that a job that shared its machine with other work, or was paused, shows
more than it needs.
"""
CHART = """
![Success by task and sensing, with 95 % intervals, and the paper's rates]({figure})

Success in the tasks of the paper's Table I by what the policy senses; the preset of its training is below each task: the first
of {presets} with which all sensings were run with as many training seeds as with any other. The thin lines are 95 % intervals,
which cover the variation over training only in tasks with several training seeds. Black lines are the paper's rates, which
come from a benchmark that differs in places ([fidelity](fidelity.md)); the tables below have the numbers.
"""
CURVES = """
![Success over the samples seen in training]({figure})

Success of the checkpoints in the course of training, with 95 % intervals. The number of samples is that of the
gradient steps times the batch size times the processes. The numbers are also available as [csv]({table}).
"""
GENTLE = """
## Gentle success

![Success against the contact force allowed, by sensing]({figure})

Share of the episodes that succeed before their contact force exceeds the force allowed, in the tasks of Table I that were run.
The curves end at the success of the tables, less the successes, at most one in twenty of a panel, that needed more force than
its axis shows. The dashed line is the limit of the task.
"""
FLOORS = """
## Failure floors

Success of policies that have learnt nothing, with 95 % Wilson intervals and the number of episodes, on the current revision
of each task. The policies are {policies}. `python -m baselines.floors` measures them; tasks that are not in the table have
not been measured.

"""
LEFT_OUT = """
Runs with fewer than {episodes} episodes or {steps:,} gradient steps, and runs whose training was stopped, have another purpose:
they are listed here, and nothing below includes them.
"""
CLAIMS = """
## The paper's claims

Each claim is tested as the difference between two conditions on the same initial states, with its 95 % interval
([method](protocol.md#the-papers-protocol)). Except for what the claim compares, both conditions have the same
preset and the paper's number of demonstrations. A preset is not the same for all policies: that of the small networks gives the
Equivariant Diffusion Policy smaller images and half as many gradient steps ([policies](policies.md)), so that claim 5 compares
these networks, too. Claim 4 may be an artefact of the public code, which trains Flow Matching
on Gaussian noise but starts generation from uniform noise ([fidelity](fidelity.md)).
"""


@dataclass
class Args:
    """Arguments of the page of results."""

    results: tuple[Path, ...]
    """Folders with result files, and with the logs of training if there are any."""
    out: Path = Path("results.md")
    """Path of the Markdown page; its figures and their table go into the folder images beside it."""
    audit: Path | None = None
    """Page with the table that `manifeel audit` wrote, which then stands beside what touch adds to success."""
    study: Path | None = None
    """File of the study that makes the results, which the page then names beside the row of each."""


@dataclass(frozen=True)
class Figures:
    """Paths of the page's figures, relative to the page; None where there is nothing to draw."""

    loss: Path | None
    """Loss over gradient steps."""
    success: Path | None
    """Success in the course of training, beside its csv file."""
    sensing: Path | None
    """Success by task and sensing."""
    gentle: Path | None
    """Success against the contact force allowed."""


def main(args: Args) -> Path:
    """Write the page, and return its path.

    A figure of the loss in training that was drawn before stays on the page where the logs of training are not at hand.

    Raises:
        InvalidArgumentError: The path of the page is that of a folder, or `audit` does not hold the table of an audit.
        ResultError: There is no result, or one is broken.
    """
    require_file("--out", args.out, "results.md")
    audit = audited(args.audit) if args.audit else {}
    by_file = results_in(*args.results)
    results = list(by_file.values())
    collected = collect(by_file)
    figures = _draw(args, by_file, of_the_protocol(collected))
    similarities = sorted(path for folder in args.results for path in folder.rglob("similarity.json"))
    links = _links(by_file, args.out.parent)
    write_text(args.out, "".join(page(results, collected, links, figures, similarities, audit, args.study)))
    return args.out


def _draw(args: Args, by_file: Mapping[Path, dict[str, Any]], found: Found) -> Figures:
    """Draw the figures of the page, those for which there are results."""
    folder, stem = args.out.parent / IMAGES, args.out.stem
    loss, success = folder / f"{stem}.png", folder / f"{stem}_success.png"
    sensing, gentle = folder / f"{stem}_sensing.png", folder / f"{stem}_gentle.png"
    drawn = {
        loss: training_curves(args.results, loss) or loss.is_file(),
        success: write_curves(by_file, success, success.with_suffix(".csv")),
        sensing: draw_sensing_by_task(found, sensing),
        gentle: draw_success_under_force(found, gentle),
    }
    return Figures(*(figure.relative_to(args.out.parent) if is_there else None for figure, is_there in drawn.items()))


def _links(by_file: Mapping[Path, dict[str, Any]], folder: Path) -> Files:
    """Links from a folder to the last checkpoint's result of each run."""
    last: dict[Condition, dict[int | None, tuple[int, str]]] = {}
    for path, result in by_file.items():
        runs, seed = last.setdefault(condition_of(result), {}), result["training_seed"]
        here = (result["config"].get("step", 0), _address(os.path.relpath(path, folder)))
        runs[seed] = max(here, runs.get(seed, here))
    return {condition: [link for _, link in in_order_of_seeds(runs)] for condition, runs in last.items()}


def _address(path: str | os.PathLike[str]) -> str:
    """A path as the address of a link in Markdown, which ends at a space or a parenthesis."""
    return quote(str(path), safe="/+")


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
        if not (last := path.parent / CHECKPOINTS / LAST_LINK).exists():  # the run has no checkpoint yet
            continue
        config = checkpoint_config(last)
        entries = [entry for entry in read_json_lines(path) if TRAINING_LOSS in entry]
        name = f"{config['policy_name']}, {config['obs_mode']}, seed {config.get('seed')}"
        runs.setdefault(config["env_id"], []).append((name, entries))
    if not runs:
        return False
    fig = Figure(figsize=(PANEL[0] * len(runs), PANEL[1]), layout="constrained")
    axes = fig.subplots(1, len(runs), squeeze=False)[0]
    for ax, (task, curves) in zip(axes, runs.items(), strict=True):
        for name, entries in curves:
            ax.plot([entry["step"] for entry in entries], [entry[TRAINING_LOSS] for entry in entries], label=name, lw=1)
        ax.set(title=task, xlabel="gradient step", ylabel="loss", yscale="log")
        ax.legend(fontsize=LEGEND_SIZE)
    save_figure(fig, out, DPI)
    return True


def page(
    results: list[dict[str, Any]],
    collected: dict[Condition, ConditionResults],
    files: Files,
    figures: Figures,
    similarities: Sequence[Path],
    audit: Mapping[str, Sequence[str]],
    study: Path | None = None,
) -> Iterator[str]:
    """The Markdown page, part by part.

    Args:
        results: Contents of result files.
        collected: The same results by condition.
        files: Links to the result files of conditions.
        figures: Paths of the figures.
        similarities: Files that `manifeel similarity` wrote.
        audit: What the information audit found, by the names of tasks.
        study: File of the study that makes the results; None if they are of no study.
    """
    found = of_the_protocol(collected)
    yield HEAD.format(last=LAST)
    if figures.sensing:
        yield CHART.format(figure=_address(figures.sensing), presets=", ".join(f"`{name}`" for name in FULLEST))
    yield from tables_of_the_paper(found, files)
    yield from touch_gains(found, results, audit)
    if figures.gentle:
        yield GENTLE.format(figure=_address(figures.gentle))
    yield "\n## What was run\n\n"
    yield from table_of_runs(collected, results, files, study)
    if len(found) < len(collected):
        yield LEFT_OUT.format(episodes=FEWEST_EPISODES, steps=FEWEST_STEPS)
    if figures.success:
        yield CURVES.format(figure=_address(figures.success), table=_address(figures.success.with_suffix(".csv")))
    if figures.loss:
        yield f"\n![Loss in training over gradient steps]({_address(figures.loss)})\n"
    if rows := list(_gains_over_references(found)):
        yield "\n## What learning gained\n\nThe gain over policies that have learnt nothing, on the same initial states: the "
        yield "network before training, and the mean action of the demonstrations (`baselines/references.py`).\n\n"
        yield markdown_table(("task", "sensing", "policy", "over", "gain, points", "p"), rows)
    yield _table_of_floors()
    yield census_table(results, [condition for condition, _ in in_order(found)])
    yield rank_table(found)
    yield f"{CLAIMS}\n"
    yield _claims(found)
    yield runtime_table(results)
    yield similarity_table(similarities)


def _table_of_floors() -> str:
    """The floors of all tasks that have some on their present revision; "" where none was measured."""
    floors = [(spec, here) for spec in all_tasks().values() if (here := floors_of(spec.env_id, spec.revision))]
    rows = [
        (spec.name, spec.revision, *(f"{here[name]} of {here[name].episodes}" if name in here else None for name in POLICIES))
        for spec, here in floors
    ]
    policies = in_words(f'"{name}" ({about})' for name, about in POLICIES.items())
    return f"{FLOORS.format(policies=policies)}{markdown_table(('task', 'revision', *POLICIES), rows)}" if rows else ""


def _gains_over_references(found: dict[Condition, ConditionResults]) -> Iterator[tuple[str, ...]]:
    for (condition, results), (other, learnt_nothing) in product(in_order(found), repeat=2):
        same_task = (condition.env_id, condition.variant, condition.revision) == (other.env_id, other.variant, other.revision)
        comparable = same_task and other.obs_mode in ("none", condition.obs_mode)
        if comparable and other.policy in REFERENCES and condition.policy not in REFERENCES:
            try:
                gain, p_value = difference(results, learnt_nothing)
                cells = gain.signed, p_text(p_value) or ""
            except ResultError:
                cells = "other initial states", ""
            yield task_with_revision(condition), *map(shown, (condition.sensing, condition.policy, other.policy)), *cells


def _claims(found: dict[Condition, ConditionResults]) -> str:
    """The paper's claims, or why they cannot be tested; the other sections of the page do not depend on them."""
    try:
        return claims_page(found, results_of_claims(found))
    except ResultError as error:
        return f"They are not tested: {error}.\n"


def next_step(_args: Args, made: Path) -> str:
    """What the command made, and what one can do with it."""
    return f"{made} has all tables; `manifeel claims` tests what the paper claims on the same results"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
