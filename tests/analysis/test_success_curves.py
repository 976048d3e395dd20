"""Success in the course of training, from results of several checkpoints."""

import csv

import cv2

from manifeel_ms3.analysis.paper import TACFF, VISION
from manifeel_ms3.analysis.success_curves import success_curves, write_curves
from manifeel_ms3.evaluation.result import results_in

from .made_up import TOTAL_STEPS, page_of, write_run


def test_a_curve_has_a_point_for_each_step_over_all_seeds(tmp_path):
    for seed, rate in enumerate((0.2, 0.4)):
        write_run(tmp_path, VISION, rate, seed, checkpoints=4, batch_size=8, num_processes=2)
    ((condition, points),) = success_curves(results_in(tmp_path)).items()
    assert condition.task == "PegInsertion"
    assert [point.gradient_steps for point in points] == [TOTAL_STEPS * part // 4 for part in (1, 2, 3, 4)]
    assert [point.samples_seen for point in points] == [16 * point.gradient_steps for point in points]
    for point in points:
        assert (point.success.value, point.training_seeds, point.episodes) == (0.3, 2, 50)
        assert point.success.low < 0.3 < point.success.high


def test_a_single_checkpoint_is_no_curve(tmp_path):
    write_run(tmp_path / "runs", VISION, 0.2, checkpoints=1)
    assert not write_curves(results_in(tmp_path / "runs"), tmp_path / "curves.png", tmp_path / "curves.csv")
    assert not (tmp_path / "curves.png").exists()


def test_the_page_of_results_shows_the_curves_and_links_the_table(tmp_path):
    for mode, rate in ((VISION, 0.2), (TACFF, 0.5)):
        for task in ("PegInsertion", "GearAssembly"):
            write_run(tmp_path / "runs", mode, rate, task=task, checkpoints=3)
    page = page_of(tmp_path / "runs", tmp_path / "results.md")
    assert "(images/results_success.png)" in page
    assert "[csv](images/results_success.csv)" in page
    assert cv2.imread(str(tmp_path / "images/results_success.png")).std() > 5
    rows = list(csv.DictReader((tmp_path / "images/results_success.csv").open()))
    assert len(rows) == 2 * 2 * 3
    assert all(int(row["samples_seen"]) == 8 * int(row["gradient_steps"]) for row in rows)  # the preset's batches of 8
    (last,) = (
        row
        for row in rows
        if row["sensing"] == "rgb+tacff wrist" and row["task"] == "PegInsertion" and row["gradient_steps"] == str(TOTAL_STEPS)
    )
    assert (last["success"], last["training_seeds"], last["episodes"], last["settings"]) == ("0.5", "1", "50", "paper")
