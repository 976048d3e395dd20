"""Studies: read, planned, run on Ray; killed workers are started again, and nothing is done twice."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from baselines.studies import __main__ as matrix
from baselines.studies import cost
from baselines.studies.jobs import is_done, perform, training_args
from baselines.studies.study import StudyError, read_study, stages_of
from manifeel_ms3.analysis import results_page as page_of_results
from manifeel_ms3.evaluation.result import results_in

REPOSITORY = Path(__file__).parents[2]
TINY = """
resources: {record: {cpus: 1}, train: {cpus: 1}, evaluate: {cpus: 1}}
grids:
  - tasks: [ManiFeel-PegInsertion-v1]
    obs_modes: [tacff]
    seeds: [0]
    demos: 1
    preset: cpu
    task_args: {fit: loose, max_episode_steps: 110, randomization: {socket_xy: 0.0, start_xy: 0.0, start_z: 0.0}}
    train: {steps: 12, save-every: 6, warmup-steps: 2, batch-size: 4, policy.down-dims: [8, 16]}
    episodes: 1
    checkpoints: 2
"""


@pytest.fixture
def study(tmp_path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return path


# -------------------------------------------------------------------- planning


def test_every_combination_is_planned_once(tmp_path):
    path = tmp_path / "study.yaml"
    path.write_text("""
grids:
  - {tasks: [ManiFeel-PegInsertion-v1, ManiFeel-BallSorting-v1], obs_modes: [rgb, rgb+tacrgb], encoders: ["", t3],
     encoder_flags: {t3: {image-size: 224}}, seeds: [0, 1]}
  - {tasks: [ManiFeel-PegInsertion-v1], obs_modes: [rgb], seeds: [0]}
""")
    stages = stages_of(read_study(path))
    kinds = [stage.kind for stage in stages]
    assert (kinds.count("record"), kinds.count("train"), kinds.count("evaluate")) == (2, 12, 12)  # rgb; rgb+tacrgb with two
    touched = [stage for stage in stages if stage.settings.get("flags", {}).get("policy.encoder.tacrgb") == "t3"]
    assert len(touched) == 4
    assert all(stage.settings["flags"]["image-size"] == 224 for stage in touched)
    assert {stage.settings["camera"] for stage in stages if stage.kind == "record"} == {"wrist", "front"}
    assert len({stage.key for stage in stages}) == len(stages)


def test_a_stage_is_named_by_all_that_it_depends_on(study):
    keys = {stage.kind: stage.key for stage in stages_of(read_study(study))}
    study.write_text(TINY.replace("demos: 1", "demos: 2"))
    other = {stage.kind: stage.key for stage in stages_of(read_study(study))}
    assert all(keys[kind] != other[kind] for kind in keys)  # other data: another policy, another result
    study.write_text(TINY.replace("episodes: 1", "episodes: 2"))
    other = {stage.kind: stage.key for stage in stages_of(read_study(study))}
    assert [keys[kind] == other[kind] for kind in ("record", "train", "evaluate")] == [True, True, False]


@pytest.mark.parametrize("path", sorted((REPOSITORY / "configs").glob("*.yaml")), ids=lambda path: path.stem)
def test_the_studies_that_come_along_can_be_planned(path):
    stages = stages_of(read_study(path))
    assert {stage.kind for stage in stages} == {"record", "train", "evaluate"}
    for stage in stages:
        if stage.kind == "train":
            training_args(stage)  # its flags are known to train.py


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("grids: [", "cannot be read as a study"),
        ("[1, 2]", "is no study"),
        ("grids: []", "has no grids"),
        ("grids: [{tasks: [ManiFeel-Knitting-v1]}]", "ManiFeel-Knitting-v1.* are unknown"),
        ("grids: [{tasks: [ManiFeel-PegInsertion-v1], seed: 1}]", "'seed'.* are not known"),
        ("grids: [{seeds: [0]}]", "tasks"),
        ("grids: [{tasks: [ManiFeel-PegInsertion-v1]}]\nresources: {training: {}}", "'training'.* are not known"),
    ],
)
def test_what_is_wrong_with_a_study_is_said(study, content, word):
    study.write_text(content)
    with pytest.raises(StudyError, match=word):
        read_study(study)


def test_a_plan_tells_the_hours_from_a_trial(study, tmp_path):
    stages = stages_of(read_study(study))
    table = matrix.plan(read_study(study), stages, tmp_path)
    assert table.row_count == 4
    assert [cost.estimate(stage, tmp_path, 1).source for stage in stages] == ["a trial"] * 3
    one, two = (cost.estimate(stages[2], tmp_path, workers).seconds for workers in (1, 2))
    assert one == pytest.approx(2 * two)
    hours = cost.estimate(stages[0], tmp_path, 1).seconds / 3600
    assert 1e-4 < hours < 0.1  # one demonstration
    before = (tmp_path / "trials.json").stat().st_mtime_ns
    matrix.plan(read_study(study), stages, tmp_path)
    assert (tmp_path / "trials.json").stat().st_mtime_ns == before  # measured once


def test_what_a_machine_does_not_have_is_said(study, tmp_path):
    study.write_text(TINY.replace("train: {cpus: 1}", "train: {cpus: 1, gpus: 99}"))
    with pytest.raises(StudyError, match="train needs 99 GPUs"):
        matrix.main(matrix.Args(study, tmp_path))
    assert subprocess.run([sys.executable, "-c", "raise SystemExit(3)"], check=False).returncode == 3  # Ray has hidden nothing


# -------------------------------------------------------------------- running


def start(study: Path, root: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "baselines.studies", str(study), "--root", str(root)]
    return subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def wait_for(path: Path, process: subprocess.Popen, seconds: float = 240) -> dict:
    until = time.time() + seconds
    while not path.is_file():
        assert process.poll() is None, process.communicate()[0]
        assert time.time() < until, f"no {path}"
        time.sleep(0.1)
    return json.loads(path.read_text())


def test_a_killed_worker_is_started_again_and_nothing_is_done_twice(study, tmp_path):
    root = tmp_path / "matrix"
    record, train, evaluate = stages_of(read_study(study))
    process = start(study, root)
    os.kill(wait_for(train.folder(root) / "started.json", process)["pid"], signal.SIGKILL)
    said = process.communicate(timeout=400)[0]
    assert process.returncode == 0, said
    assert "3 of 3 stages" in said
    done = {stage.kind: json.loads((stage.folder(root) / "done.json").read_text()) for stage in (record, train, evaluate)}
    assert [done[kind]["attempts"] for kind in ("record", "train", "evaluate")] == [1, 2, 1]
    assert [done[kind]["units"] for kind in ("record", "train", "evaluate")] == [1, 12, 2]
    results = results_in(root)
    assert [result["config"]["step"] for result in results] == [6, 12]
    assert all(result["config"]["training_seconds"] > 0 for result in results)
    assert cost.estimate(train, root, 1).source == "runs here"
    page = page_of_results.main(page_of_results.Args((root,), tmp_path / "page.md")).read_text()
    assert "| PegInsertion" in page
    assert (tmp_path / "images/page.png").stat().st_size > 1000  # the curve of training

    before = {path: path.stat().st_mtime for path in root.rglob("*.json")}
    matrix.main(matrix.Args(study, root))  # all is done: Ray is not even started
    assert {path: path.stat().st_mtime for path in root.rglob("*.json")} == before


def test_what_fails_is_told_and_tried_again(study, tmp_path):
    study.write_text(TINY.replace("steps: 12", "steps: 12, image-size: -1, policy.encoder.force-field: nonsense"))
    record, train, _ = stages_of(read_study(study))
    root = tmp_path / "matrix"
    (record.folder(root)).mkdir(parents=True)
    (record.folder(root) / "done.json").write_text(json.dumps(dict(settings=record.settings)))
    with pytest.raises(Exception, match="trajectory.h5"):  # what it needs is said to be done, and is not there
        perform(train, root)
    failed = json.loads((train.folder(root) / "failed.json").read_text())
    assert "trajectory.h5" in failed["error"]
    assert not is_done(train, root)
    assert "trajectory.h5" in matrix._reason(train, root)
    (record.folder(root) / "done.json").unlink()
    perform(record, root)
    with pytest.raises(ValueError, match="nonsense"):
        perform(train, root)
    assert json.loads((train.folder(root) / "started.json").read_text())["attempts"] == 2
