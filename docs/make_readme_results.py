"""README's table of results, made anew: `python -m docs.make_readme_results` in the repository's root.

It shows Table I with the results of the folders that `make results` reads, each task with the preset of the fullest training
among those that were run with most training seeds. A test fails where README does not have what this makes.
"""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from textwrap import fill

import numpy as np

from manifeel_ms3.analysis.condition import condition_of
from manifeel_ms3.analysis.estimates import SIGNIFICANT, difference, has_enough_seeds, holm
from manifeel_ms3.analysis.markdown import in_words, markdown_table
from manifeel_ms3.analysis.paper import MODES, TABLE_I, VISION
from manifeel_ms3.analysis.paper_comparison import gpu_of_training
from manifeel_ms3.analysis.paper_tables import HEADINGS, overview_of_table_one
from manifeel_ms3.analysis.protocol import ConditionResults, collect, of_the_protocol
from manifeel_ms3.evaluation.floors import highest_floor
from manifeel_ms3.evaluation.result import results_in, successes_by_the_paper
from manifeel_ms3.files import write_text
from manifeel_ms3.tasks.registry import task_spec

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
RESULTS = sorted(ROOT.glob("leaderboard/cpu*")) + sorted(ROOT.glob("docs/cpu*"))
BLOCK = re.compile(r"(<!-- --8<-- \[start:results\] -->\n).*(?=<!-- --8<-- \[end:results\] -->)", re.DOTALL)
"""README's part between the marks with which the home page of the documentation includes it."""
ROWS = {
    "ObjectSearch": "ObjectSearch, a battery in a box that hides it",
    "BallSortingDim": "BallSortingDim, a golf ball in dim light",
    "PowerPlugInsertion": "PowerPlugInsertion",
    "GearAssembly": "GearAssembly, 0.5 mm of play on each side",
    "PegInsertion": "PegInsertion, 0.5 mm of play on each side",
    "USBInsertion": "USBInsertion",
    "NutBoltAssembly": "NutBoltAssembly",
    "BulbInstallation": "BulbInstallation",
    "PegReorientation": "PegReorientation, a peg turned in the hand",
}
"""First cells of the rows, in the order of the table."""
LEAD = """
**What touch adds, in numbers:** success rates (at any step of an episode) of Diffusion Policy with small networks, with the
standard deviation (±) over three training seeds and, in brackets, the paper's rates, which come from much larger networks,
demonstrations by people, another simulator and a looser success. Vision is one camera: the wrist camera, or in ObjectSearch,
PegReorientation and BallSortingDim the front camera. Every policy also gets the pose of the tool, and those with touch the
right fingertip's sensor. Bold rates are significantly above those of vision alone. Policies that have learnt nothing solve
{floor} in each of these tasks; in ObjectSearch and BallSortingDim, choosing one of the two places or balls at random would
give 50 %.
"""
DETAILS = """
Each training took {fastest:.0f} to {slowest:.0f} minutes on one CPU core that other work often shared{on_gpu}, with as many
demonstrations as in the paper's Table I (50; NutBoltAssembly 30, BulbInstallation 20). The last checkpoint was evaluated,
where the paper averages ten, on {episodes} initial states that no demonstration has. Success is stricter than in the paper's
public code: by its threshold, {by_the_paper}. A preset is a set of training settings: `cpu_long` trains longer than `cpu`, in
`cpu_targets` a policy predicts where the hand is to be instead of how far it moves, and in `cpu_noisy_pose` noise hides from
it where the hand is. The presets were chosen by trials on these same states, so that rates on others may be lower. Rates
without ± have one or two training seeds: others may change them. "Significantly" means p < {p}, corrected for the table's
{tests} comparisons of rates with three seeds. The last column has the success at the last step of the episode.
"""
STRICTER = "PegReorientation"
"""Task whose success here is far stricter than by the threshold of the paper's public code."""
WIDTH = 140
"""Width of README's lines, in characters."""


def block() -> str:
    """README's text on the results.

    Raises:
        ResultError: There is no result, or one is broken.
    """
    results = results_in(*RESULTS)
    found = of_the_protocol(collect(results))
    overview = overview_of_table_one(found)
    conditions = {(task, mode): condition for task, (_, by_mode) in overview.items() for mode, condition in by_mode.items()}
    here = {place: found[condition] for place, condition in conditions.items()}
    gains = _corrected_gains(here)
    trained = [result["config"] for result in results.values() if condition_of(result) in conditions.values()]
    timed = [config for config in trained if "training_seconds" in config]
    minutes = [config["training_seconds"] / 60 for config in timed if not gpu_of_training(config)]
    on_gpu = [config["training_seconds"] / 60 for config in timed if gpu_of_training(config)]
    figures = dict(
        fastest=min(minutes),
        slowest=max(minutes),
        on_gpu=f" ({len(on_gpu)} of {len(trained)} on a GPU, in at most {math.ceil(max(on_gpu))} minutes)" if on_gpu else "",
        episodes=min(len(ours.episode_seeds) for ours in here.values()),
        p=SIGNIFICANT,
        tests=len(gains),
        by_the_paper=f"{STRICTER} has {in_words(_rates_by_the_paper(here))} %",
        floor=_floor(),
    )
    raised = {place for place, p_holm in gains.items() if p_holm < SIGNIFICANT}
    presets = {task: f"`{settings.preset}`" for task, (settings, _) in overview.items()}
    rows = [(label, presets.get(task), *_cells(task, here, raised), _at_end(task, here)) for task, label in ROWS.items()]
    lead, details = (fill(text.format(**figures).strip(), WIDTH) for text in (LEAD, DETAILS))
    headings = ("", "preset", *HEADINGS.values(), "at the last step: vision, TacRGB, TacFF")
    return f"{lead}\n\n{markdown_table(headings, rows)}\n{details}\n"


Results = dict[tuple[str, str], ConditionResults]
"""Results by task and observation mode."""


def _corrected_gains(results: Results) -> dict[tuple[str, str], float]:
    """P-values after Holm's correction of the gains over vision alone, by task and mode; 1 for a loss.

    Comparisons with too few training seeds are left out.
    """
    pairs = {(task, mode): (ours, results.get((task, VISION))) for (task, mode), ours in results.items() if mode != VISION}
    tested = {place: difference(*pair) for place, pair in pairs.items() if pair[1] and has_enough_seeds(*pair)}
    corrected = holm([p_value for _, p_value in tested.values()])
    return {
        place: p_holm if gain.value > 0 else 1.0 for (place, (gain, _)), p_holm in zip(tested.items(), corrected, strict=True)
    }


def _rates_by_the_paper(results: Results) -> list[str]:
    """Success in `STRICTER` by the threshold of the paper's public code with each sensing, in percent."""
    episodes = [successes_by_the_paper(results[STRICTER, mode].episodes) for mode in MODES]
    return [f"{100 * np.mean(successes):.0f}" for successes in episodes if successes is not None]


def _floor() -> str:
    """The largest success of policies that have learnt nothing, in words."""
    floors = [floor for spec in map(task_spec, ROWS) if (floor := highest_floor(spec.env_id, spec.revision))]
    highest = max(floors, key=lambda floor: floor.rate)
    return f"at most {100 * highest.rate:.0f} %" if highest.rate else f"none of {highest.episodes} episodes"


def _at_end(task: str, results: Results) -> str:
    """Success at the last step with each sensing, in percent."""
    here = [results[task, mode] for mode in MODES if (task, mode) in results]
    return ", ".join(_percent(ours, ours.success_at_end, ours.seed_deviation_at_end) for ours in here) + " %"


def _cells(task: str, results: Results, raised: set[tuple[str, str]]) -> Iterator[str]:
    """A rate for each sensing, with the paper's in brackets; in bold letters if it is one of those that touch raises."""
    for mode, paper in zip(MODES, TABLE_I[task], strict=True):
        rate = _rate(results[task, mode]) if (task, mode) in results else "not run"
        yield f"{f'**{rate}**' if (task, mode) in raised else rate} ({100 * paper.mean:.0f})"


def _rate(ours: ConditionResults) -> str:
    return f"{_percent(ours, ours.success.mean(), ours.seed_deviation)} %"


def _percent(ours: ConditionResults, rate: float | None, deviation: float | None) -> str:
    """A rate in percent, without the sign, and its standard deviation over training seeds where these are enough."""
    if rate is None:
        return "?"
    spread = f" ± {100 * deviation:.0f}" if deviation is not None and has_enough_seeds(ours) else ""
    return f"{100 * rate:.0f}{spread}"


def main() -> None:
    text = README.read_text(encoding="utf-8")
    write_text(README, BLOCK.sub(lambda found: found[1] + block(), text))


if __name__ == "__main__":
    main()
