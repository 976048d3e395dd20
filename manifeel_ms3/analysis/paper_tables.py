"""The paper's tables in the paper's form: each cell has our success with its interval, and the paper's."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from manifeel_ms3.command_line import missing_extras_named
from manifeel_ms3.evaluation.floors import highest_floor
from manifeel_ms3.tasks.registry import task_spec

from .condition import Condition
from .estimates import Estimate, mean_success
from .figures import save_figure
from .markdown import markdown_table
from .matching import Found, answering, of_table_one
from .paper import DP, MODES, TABLE_I, TABLE_II, TABLE_III, Rate, paper_condition, tasks_in_table
from .presets import PAPER, TrainingSettings
from .protocol import ConditionResults

TEXT = """
## The paper's tables

Each cell has our success with its 95 % interval and, after the slash, the paper's. A rate links to its result file; where there
are several training seeds, the mean is followed by the rate of each seed. Only conditions with the paper's number of
demonstrations appear, and each set-up has its own tables. The interval of a rate with one training seed says nothing about how
much training itself varies; where there are several seeds, the interval covers that, too. "Floor" is the highest success of
policies that have learnt nothing, where it was measured ([failure floors](#failure-floors)). The presets of the three policies
differ in more than the policy ([how](policies.md)). The paper contradicts itself on ball sorting: its list of set-ups has only
dim light, but its Tables I and II report different rates for the same policies. The studies of Tables II and III therefore have
both lights.
"""
NOT_RUN = """
Not run: {what}. `manifeel study configs/tables_cpu.yaml` runs Tables I and II with small networks on a CPU, and
`manifeel study configs/paper.yaml` everything with the networks of the paper, on a GPU; with `--dry-run`, both estimate the
hours on your machine.
"""
Files = Mapping[Condition, Sequence[str]]
"""Links to result files of conditions: the last checkpoint's of each training seed, in the order of `ConditionResults`."""
HEADINGS: dict[str, str] = dict(zip(MODES, ("vision", "vision + TacRGB", "vision + TacFF"), strict=True))
"""Headings of the tables' columns, by observation mode."""
PANEL = (11.0, 4.2)
"""Width and height of the bar chart, in inches."""
DPI = 110
"""Resolution of the figures, in pixels per inch."""
LEGEND_SIZE = 8
"""Size of the letters in the legends, in points."""
LABEL_ANGLE = 20
"""Angle of the names of the tasks below the bar chart, in degrees, so that they do not overlap."""
PAPER_LINE = 1.5
"""Width of the lines for the paper's rates, in points."""
COLOURS: dict[str, str] = dict(zip(MODES, ("#9aa0a6", "#d9822b", "#2b6cb0"), strict=True))
"""Colour of each observation mode in the figures."""
BAR = 0.27
"""Width of a bar; tasks are 1 apart."""


def tables_of_the_paper(found: Found, files: Files) -> Iterator[str]:
    """Markdown of Tables I to III, part by part.

    Args:
        found: The results that enter comparisons.
        files: Links to the result files of conditions.
    """
    yield TEXT
    all_settings, with_other_policies, by_encoder = _all_settings(found), set[str](), False
    for settings in all_settings:
        if rows := list(_rows_by_sensing(found, files, settings, {(task, DP): rates for task, rates in TABLE_I.items()})):
            yield f"\n### Table I, what touch adds: Diffusion Policy, {settings}\n\n"
            yield _with_floors(("task", *HEADINGS.values()), [(task, *cells) for (task, _), cells in rows])
        by_policy = {(task, name): rates for task, here in TABLE_II.items() for name, rates in here.items()}
        rows = list(_rows_by_sensing(found, files, settings, by_policy))
        if others := {task for (task, policy), _ in rows if policy != DP}:
            with_other_policies |= others
            yield f"\n### Table II, three policies: {settings}\n\n"
            compared = [(*what, *cells) for what, cells in rows if what[0] in others]
            yield _with_floors(("task", "policy", *HEADINGS.values()), compared)
        if rows := list(_rows_by_encoder(found, files, settings)):
            by_encoder = True
            yield f"\n### Table III, encoders of TacRGB: {settings}\n\n"
            names = list(dict.fromkeys(name for here in TABLE_III.values() for name in here))
            yield _with_floors(("task", *names), rows)
    missing = [] if any(settings.preset == PAPER for settings in all_settings) else ["the networks of the paper (ResNet-18)"]
    if left := [task for task in TABLE_II if task not in with_other_policies]:
        where = f", on {', '.join(left)}" if with_other_policies else ""
        missing.append(f"Table II, the Equivariant Diffusion Policy and Flow Matching{where}")
    if not by_encoder:
        missing.append("Table III, the encoders with published weights")
    if missing:
        yield NOT_RUN.format(what="; ".join(missing))


def _with_floors(names: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, with a column for the failure floors of the tasks in its first column if any of them is known."""
    specs = [task_spec(task) for task, *_ in rows]
    floors = [highest_floor(spec.env_id, spec.revision) for spec in specs]
    if not any(floors):
        return markdown_table(names, rows)
    return markdown_table((*names, "floor"), [(*row, floor) for row, floor in zip(rows, floors, strict=True)])


def _all_settings(found: Found) -> list[TrainingSettings]:
    """The set-ups of conditions of Tables I to III, the paper's preset first."""
    wanted = [paper_condition(task, mode, policy) for task in TABLE_II for policy in TABLE_II[task] for mode in MODES]
    wanted += [paper_condition(task, mode) for task in TABLE_I for mode in MODES]
    all_settings = {settings for condition in wanted for settings in answering(condition, found)}
    return sorted(all_settings, key=lambda settings: settings.sort_key)


Rows = Mapping[tuple[str, str], tuple[Rate, ...]]


def _rows_by_sensing(
    found: Found, files: Files, settings: TrainingSettings, rows: Rows
) -> Iterator[tuple[tuple[str, str], list[str]]]:
    """Task and policy, and a cell for each observation mode; only rows of which some condition was run."""
    for (task, policy), rates in rows.items():
        answers = [answering(paper_condition(task, mode, policy), found).get(settings) for mode in MODES]
        if any(answers):
            cells = [_cell(found, files, answer, rate) for answer, rate in zip(answers, rates, strict=True)]
            yield (task, policy), cells


def _rows_by_encoder(found: Found, files: Files, settings: TrainingSettings) -> Iterator[list[str]]:
    for task in tasks_in_table("III"):
        wanted = {name: paper_condition(task, MODES[1], encoder=name) for name in TABLE_III[task]}
        answers = {name: answering(condition, found).get(settings) for name, condition in wanted.items()}
        if sum(answer is not None for answer in answers.values()) > 1:  # a single encoder compares nothing
            yield [task, *(_cell(found, files, answers[name], rate) for name, rate in TABLE_III[task].items())]


def _cell(found: Found, files: Files, condition: Condition | None, rate: Rate) -> str:
    if condition is None:
        return f"not run / {rate}"
    return f"{success_with_links(found[condition], files.get(condition, ()))} / {rate}"


def success_with_links(results: ConditionResults, files: Sequence[str]) -> str:
    """The success of a condition, as text, such as "40% [25%, 56%] (34%, 54%, 32%)": the rates of the runs link to their files.

    Args:
        results: Success of the condition in every episode.
        files: Links to a result file of each training seed, in their order; no links if empty.
    """
    success = mean_success(results)
    if len(results.success) == 1:
        return linked(success, files[0] if files else None)
    rates = [f"{rate:.0%}" for rate in results.success.mean((1, 2))]
    runs = [f"[{rate}]({file})" for rate, file in zip(rates, files, strict=True)] if files else rates
    return f"{success} ({', '.join(runs)})"


def linked(success: Estimate, file: str | None) -> str:
    """A success with its interval, as text; the number itself links to a file if one is given."""
    value, _, interval = str(success).partition(" ")
    return f"[{value}]({file}) {interval}" if file else f"{value} {interval}"


def overview_of_table_one(found: Found) -> dict[str, tuple[TrainingSettings, dict[str, Condition]]]:
    """The settings of each task of Table I that was run, and its conditions by observation mode.

    Where a task was run with several settings, these are the ones with which most of its observation modes were run; among
    equals, the ones with most training seeds in every mode, and then those of the fullest training (`presets.FULLEST`).

    Args:
        found: The results that enter comparisons.
    """
    overview = {}
    for task in TABLE_I:
        if by_settings := of_table_one(task, found):
            overview[task] = min(
                by_settings.items(), key=lambda item: (-len(item[1]), -_num_seeds(item[1], found), item[0].fullness)
            )
    return overview


def _num_seeds(by_mode: dict[str, Condition], found: Found) -> int:
    """The number of training seeds of the condition that has the fewest."""
    return min(len(found[condition].success) for condition in by_mode.values())


def draw_sensing_by_task(found: Found, out: Path) -> bool:
    """Draw the success of Table I as bars: tasks side by side, a bar for each sensing, the paper's rates as black lines.

    A task that was not run has the paper's lines alone. `overview_of_table_one` says which settings a task has.

    Args:
        found: The results that enter comparisons.
        out: Path of the figure.

    Returns:
        Whether there is something to draw.

    Raises:
        MissingExtraError: The extra `report`, which draws, is not installed.
    """
    if not (overview := overview_of_table_one(found)):
        return False
    with missing_extras_named():
        from matplotlib.figure import Figure
    drawn = {(task, mode): mean_success(found[one]) for task, (_, by_mode) in overview.items() for mode, one in by_mode.items()}
    tasks = list(TABLE_I)
    names = [_name_in_chart(task, overview, found) for task in tasks]
    fig = Figure(figsize=PANEL, layout="constrained")
    ax = fig.subplots()
    for k, mode in enumerate(MODES):
        _draw_bars(ax, (k - 1) * BAR, [drawn.get((task, mode)) for task in tasks], mode)
    for place, task in enumerate(tasks):
        for k, rate in enumerate(TABLE_I[task]):
            label = "the paper" if place == k == 0 else None
            left = place + (k - 1.5) * BAR
            ax.plot([left, left + BAR], [rate.mean] * 2, color="black", lw=PAPER_LINE, label=label)
    ax.set(ylabel="success", ylim=(0, 1), title="What touch adds: Diffusion Policy")
    ax.set_xticks(range(len(tasks)), names, rotation=LABEL_ANGLE, ha="right")
    ax.legend(ncols=1 + len(MODES), fontsize=LEGEND_SIZE, loc="upper left")
    save_figure(fig, out, DPI)
    return True


def _name_in_chart(task: str, overview: Mapping[str, tuple[TrainingSettings, dict[str, Condition]]], found: Found) -> str:
    """Name of a task, with the preset of its bars, and whether they are of one training seed."""
    if task not in overview:
        return task
    settings, by_mode = overview[task]
    seeds = ", one seed" if all(len(found[condition].success) == 1 for condition in by_mode.values()) else ""
    return f"{task}\n({settings.preset}{seeds})"


def _draw_bars(ax: Any, shift: float, estimates: list[Estimate | None], mode: str) -> None:
    known = [(place + shift, one) for place, one in enumerate(estimates) if one is not None]
    heights = [one.value for _, one in known]
    errors = [[one.value - one.low for _, one in known], [one.high - one.value for _, one in known]]
    centres = [place for place, _ in known]
    ax.bar(centres, heights, BAR, color=COLOURS[mode], label=HEADINGS[mode])
    ax.errorbar(centres, heights, errors, fmt="none", ecolor="#333333", elinewidth=1, capsize=2)
