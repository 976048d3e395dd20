"""Studies: run on Ray; killed workers are started again, and nothing is done twice."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from baselines.studies import __main__ as study_command
from baselines.studies import cost
from baselines.studies.jobs import is_done, perform
from baselines.studies.planning import jobs_of
from baselines.studies.study import Resources, read_study
from manifeel_ms3.analysis import results_page as page_of_results
from manifeel_ms3.errors import InvalidFileError, UnknownNameError
from manifeel_ms3.evaluation import evaluate as evaluation
from manifeel_ms3.evaluation.result import results_in
from tests.tiny_study import TINY

REPOSITORY = Path(__file__).parents[2]


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


def test_a_killed_worker_is_started_again_and_nothing_is_done_twice(study, tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    root = tmp_path / "study"
    record, train, evaluate = jobs_of(read_study(study))
    process = start(study, root)
    os.kill(wait_for(train.folder(root) / "started.json", process)["pid"], signal.SIGKILL)
    said = process.communicate(timeout=400)[0]
    assert process.returncode == 0, said
    assert "3 of 3 jobs" in said
    assert "infeasible" not in said  # Ray's word for a job that waits until the one before it has given its processor back
    done = {job.kind: json.loads((job.folder(root) / "done.json").read_text()) for job in (record, train, evaluate)}
    assert [done[kind]["attempts"] for kind in ("record", "train", "evaluate")] == [1, 2, 1]
    assert [done[kind]["units"] for kind in ("record", "train", "evaluate")] == [1, 12, 2]
    results = list(results_in(root).values())
    assert [result["config"]["step"] for result in results] == [6, 12]
    assert all(result["config"]["training_seconds"] > 0 for result in results)
    assert cost.estimate(train, root, 1).source == "runs here"
    page = page_of_results.main(page_of_results.Args((root,), tmp_path / "page.md")).read_text()
    assert "| PegInsertion" in page
    assert (tmp_path / "images/page.png").stat().st_size > 1000  # the curve of training

    board = tmp_path / "leaderboard"
    study_command.main(study_command.Args(study, root, publish=board / "tiny", authors="the authors of this test"))
    monkeypatch.chdir(tmp_path)
    (entry,) = (path.parents[1].relative_to(board).as_posix() for path in board.rglob("00000012.json"))
    about = json.loads((board / "tiny/submission.json").read_text())
    assert len(about["checkpoints"]) == 2
    other, gone = "Another/rgb/seed0/00000012.json", "Gone/rgb/seed0/00000012.json"
    (board / "tiny" / other).parent.mkdir(parents=True)
    (board / "tiny" / other).write_text("of another machine")
    hashes = about["checkpoints"] | {other: "0" * 64, gone: "0" * 64}
    (board / "tiny/submission.json").write_text(json.dumps(about | dict(checkpoints=hashes)))
    study_command.main(study_command.Args(study, root, publish=board / "tiny"))
    hashes.pop(gone)  # whose result is not there
    assert json.loads((board / "tiny/submission.json").read_text())["checkpoints"] == hashes
    assert (board / "tiny" / other).read_text() == "of another machine"
    evaluation.main(evaluation.Args(entry=entry, episodes=1))
    assert f"1 of 1 episodes agree with those of the entry {entry}" in caplog.text
    (board / entry / "seed0/checkpoints/00000012/config.json").write_text("{}")
    with pytest.raises(InvalidFileError, match="the checkpoint was changed; get it anew"):
        evaluation.main(evaluation.Args(entry=entry, episodes=1))
    with pytest.raises(UnknownNameError, match=rf"no entry 'tiny/Knitting' .* choose from \['{re.escape(entry)}'\]"):
        evaluation.main(evaluation.Args(entry="tiny/Knitting"))

    before = {path: path.stat().st_mtime for path in root.rglob("*.json")}
    study_command.main(study_command.Args(study, root))  # all is done: Ray is not even started
    assert {path: path.stat().st_mtime for path in root.rglob("*.json")} == before


def test_what_fails_is_told_and_tried_again(study, tmp_path):
    study.write_text(TINY.replace("steps: 12", "steps: 12, policy.encoder.force-field: nonsense"))
    record, train, _ = jobs_of(read_study(study))
    root = tmp_path / "study"
    (record.folder(root)).mkdir(parents=True)
    (record.folder(root) / "done.json").write_text(json.dumps(dict(settings=record.settings)))
    with pytest.raises(Exception, match=r"trajectory\.h5"):  # what it needs is said to be done, and is not there
        perform(train, root, Resources())
    failed = json.loads((train.folder(root) / "failed.json").read_text())
    assert "trajectory.h5" in failed["error"]
    assert not is_done(train, root)
    assert "trajectory.h5" in study_command._reason(train, root, {})
    (record.folder(root) / "done.json").unlink()
    perform(record, root, Resources())
    with pytest.raises(ValueError, match="nonsense"):
        perform(train, root, Resources())
    assert json.loads((train.folder(root) / "started.json").read_text())["attempts"] == 2
