"""The page of results is written from whatever results are at hand."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from matplotlib.container import ErrorbarContainer

from manifeel_ms3.analysis import claims, paper_tables, results_page
from manifeel_ms3.analysis.estimates import mean_success
from manifeel_ms3.analysis.paper import MODES, TACFF, VISION, paper_condition
from manifeel_ms3.analysis.paper_tables import overview_of_table_one
from manifeel_ms3.analysis.protocol import ConditionResults, collect
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation.result import result_of, results_in
from manifeel_ms3.tasks.registry import evaluation_seeds
from tests.outcomes import made_up
from tests.tasks_and_marks import PEG

from .made_up import page_of, write_run


def test_conditions_with_other_initial_states_cost_the_page_their_comparison_alone(tmp_path):
    write_run(tmp_path, VISION, 0.2)
    write_run(tmp_path, TACFF, 0.5, episodes=60)
    config = dict(policy_name="baselines.references:MeanAction", obs_mode="none", policy_kwargs={})
    result = result_of(PEG, dict(obs_mode="none"), config, [made_up(seed, False) for seed in evaluation_seeds(60)])
    (tmp_path / "0.json").write_text(json.dumps(result))
    page = page_of(tmp_path)
    assert "| rgb wrist | diffusion_policy | MeanAction | other initial states |  |" in page
    assert "| rgb+tacff wrist | diffusion_policy | MeanAction | +50 [" in page
    assert "on different initial states, 60 and 50 of them; evaluate both with the same --num-eval-episodes.\n" in page
    assert "## Training time" in page


def test_links_lead_to_files_whose_names_have_spaces_and_parentheses(tmp_path):
    folder = tmp_path / "trial (2) ü"
    folder.mkdir()
    write_run(folder, VISION, 0.2)
    page_of(folder, tmp_path / "my page.md")
    page = (tmp_path / "my page.md").read_text()
    links = re.findall(r"\]\(([^)\s]+)\)", page)
    linked = [tmp_path / unquote(link) for link in links if link.endswith(("000.json", ".png", ".csv"))]
    assert {path.suffix for path in linked} == {".json", ".png", ".csv"}
    assert all(path.is_file() for path in linked)


def test_texts_of_a_result_are_shown_as_texts(tmp_path):
    """Neither Markdown nor HTML, nor a further cell of a table, comes from a stranger's result."""
    nasty = "<img src=x onerror=alert(1)> | b ![c](javascript:d) `e`"
    write_run(tmp_path, VISION, 0.2, checkpoints=1)
    (path,) = tmp_path.rglob("evaluations/*.json")
    result = json.loads(path.read_text())
    result["config"] |= {
        "note": nasty,
        "batch_size": 0,
        "num_samples": "many",
        "trained_on": dict(cpu=nasty, cores=1, gpu=None),
    }
    result["env_kwargs"] |= {"fit": nasty}
    for episode in result["episodes"]:
        episode["ending"] = nasty
    path.write_text(json.dumps(result | dict(policy=f"a:{nasty}")))
    page = page_of(tmp_path)
    assert "<img" not in page
    assert "![c]" not in page
    for table in re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE):
        assert len({row.count("|") for row in table.splitlines()}) == 1


def test_a_folder_in_the_place_of_the_page_or_the_table_is_refused_before_anything_is_drawn(tmp_path):
    write_run(tmp_path / "run", VISION, 0.5)
    before = sorted(tmp_path.rglob("*"))
    for module in (results_page, claims):
        with pytest.raises(InvalidArgumentError, match="is a folder; give the path of a file"):
            module.main(module.Args((tmp_path,), tmp_path))
    assert sorted(tmp_path.rglob("*")) == before


def test_results_that_a_killed_process_was_copying_are_left_out(tmp_path):
    write_run(tmp_path / "cpu", VISION, 0.2)
    shutil.copytree(tmp_path / "cpu", tmp_path / ".cpu.here-1-abc.partial/cpu")
    assert len(results_in(tmp_path)) == 2


def test_the_overview_of_table_one_has_the_fullest_training_that_was_run_with_every_sensing_and_most_seeds(tmp_path):
    for preset, modes in (("cpu", MODES), ("cpu_long", MODES), ("paper", (VISION,))):
        for mode in modes:
            write_run(tmp_path, mode, 0.2, preset=preset)
    write_run(tmp_path, VISION, 0.2, preset="cpu", task="USBInsertion")
    for preset, seeds in dict(cpu=(0, 1), cpu_long=(0,)).items():
        for seed in seeds:
            write_run(tmp_path, VISION, 0.2, seed, "GearAssembly", preset=preset)
    overview = overview_of_table_one(collect(results_in(tmp_path)))
    assert {task: (settings.preset, list(by_mode)) for task, (settings, by_mode) in overview.items()} == {
        "PegInsertion": ("cpu_long", list(MODES)),
        "USBInsertion": ("cpu", [VISION]),
        "GearAssembly": ("cpu", [VISION]),
    }


def made_up_success(rate: float) -> ConditionResults:
    won = np.random.default_rng(round(100 * rate)).random((3, 1, 50)) < rate
    return ConditionResults(won.astype(float), list(range(50)))


def test_the_bars_of_the_figure_have_the_intervals_of_the_rates(tmp_path, monkeypatch):
    """Of two set-ups, the figure shows the one that has more of the conditions."""
    conditions = [paper_condition(task, mode) for task in ("PegInsertion", "ObjectSearch") for mode in MODES]
    shown = {condition: made_up_success(0.1 + 0.15 * k) for k, condition in enumerate(conditions)}
    other = replace(conditions[0], settings=(("lr", "0.5"),))
    figures = []
    monkeypatch.setattr(paper_tables, "save_figure", lambda figure, *_: figures.append(figure))
    for found in ({other: made_up_success(0.9)} | shown, shown | {other: made_up_success(0.9)}):
        assert paper_tables.draw_sensing_by_task(found, tmp_path / "figure.png")
        (ax,) = figures.pop().axes
        lines = [line for bars in ax.containers if isinstance(bars, ErrorbarContainer) for line in bars.lines[2]]
        drawn = {tuple(segment[:, 1].round(6)) for line in lines for segment in line.get_segments()}
        rates = [mean_success(results) for results in shown.values()]
        assert drawn == {(round(rate.low, 6), round(rate.high, 6)) for rate in rates}


def test_the_rate_of_a_training_seed_is_that_of_all_its_checkpoints():
    success = np.zeros((2, 2, 50))
    success[0, 1] = 1.0
    shown = paper_tables.success_with_links(ConditionResults(success, list(range(50))), ["first.json", "second.json"])
    assert shown.endswith("([50%](first.json), [0%](second.json))")


def test_each_row_of_a_study_says_how_it_is_made_again(tmp_path):
    write_run(tmp_path, VISION, 0.2, preset="cpu_targets")
    write_run(tmp_path, TACFF, 0.2, preset="cpu", batch_size=3)  # of no study, since it has no preset's settings
    page = results_page.main(results_page.Args((tmp_path,), tmp_path / "page.md", study=Path("configs/mine.yaml"))).read_text()
    rows = [line for line in page.splitlines() if line.startswith("| PegInsertion") and " h |" not in line]
    named = [line.rpartition(" | ")[2] for line in rows if "diffusion_policy" in line and "`" in line.rpartition(" | ")[2]]
    assert named == ["`PegInsertion, diffusion_policy, cpu_targets, rgb, wrist, 50 demonstrations` |"]
    assert "`manifeel study configs/mine.yaml --only 'ROW'`" in page
    assert "row in the study" not in page_of(tmp_path)
