"""The results in the repository can be run again from the checkpoints beside them."""

import json
import re
from pathlib import Path

import pytest

from docs.make_entry_videos import video_of
from manifeel_ms3.evaluation import evaluate
from manifeel_ms3.evaluation.checkpoint_config import published_hash
from manifeel_ms3.evaluation.entries import Entry, find_entry
from manifeel_ms3.evaluation.result import read_result
from manifeel_ms3.leaderboard.checks import check
from manifeel_ms3.leaderboard.rerun import checkpoint_sources, checkpoints_in, run_again
from manifeel_ms3.leaderboard.submission import read_submission
from manifeel_ms3.provenance import machine
from tests.outcomes import made_up
from tests.tasks_and_marks import PEG, needs_renderer
from tests.trust.tiny_checkpoint import save_tiny_checkpoint

BOARD = Path(__file__).parents[2] / "leaderboard"
ENTRY = "cpu/PegInsertion/rgb+tacff"
SIZE = 80 * 10**6
"""Largest size of all checkpoints in the repository, in bytes."""


def test_every_entry_that_succeeds_has_a_video_and_the_checkpoint_that_its_submission_names():
    results = sorted(BOARD.glob("*/**/seed0/*.json"))
    assert results
    for path in results:
        result = json.loads(path.read_text())
        if not (path.parent / "checkpoints").exists():  # left out, to save space
            assert result["success_once"]["rate"] == 0, path
            continue
        assert find_entry(path.parents[1].relative_to(BOARD).as_posix()).result == result
        assert video_of(path).is_file(), "run `python -m docs.make_entry_videos`"
    assert sum(path.stat().st_size for path in BOARD.rglob("*.safetensors")) < SIZE


def test_the_submissions_in_the_repository_can_be_shown():
    folders = [folder for folder in BOARD.iterdir() if folder.is_dir()]
    assert folders
    for folder in folders:
        check(read_submission(folder), to_take=False)  # raises an error if there is a fault


@needs_renderer
def test_an_entry_is_run_again(tmp_path, caplog):
    caplog.set_level("INFO")
    out = evaluate.main(evaluate.Args(entry=ENTRY, episodes=1, out=tmp_path / "again.json"))
    again, published = json.loads(out.read_text()), find_entry(ENTRY).result
    assert again["config"] == published["config"]
    assert again["episodes"][0]["seed"] == published["episodes"][0]["seed"]
    said = re.search(rf"(\d) of 1 episodes agree with those of the entry {re.escape(ENTRY)}", caplog.text)
    assert said
    if machine()["cpu"] == published["machine"]["cpu"] and again["versions"] == published["versions"]:
        assert said[1] == "1"  # other processors round differently


def test_outcomes_that_differ_are_counted_and_the_first_is_named():
    entry = find_entry(ENTRY)
    first = entry.result["episodes"][0]
    seed, other = first["seed"], not first["success_once"]
    said = entry.agreement([made_up(seed, other)])
    counts = f"{int(other)} succeed here, {int(not other)} there"
    assert said.startswith(f"0 of 1 episodes agree with those of the entry {ENTRY}; {counts}. ")
    assert f"In the episode of seed {seed}, success_once says {not other}, run again it is {other}" in said
    assert entry.agreement([made_up(seed - 1, other)]).startswith("no episode is compared with those of the entry")


def test_an_entry_is_run_again_with_its_own_settings_unless_others_are_given(tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    run = tmp_path / "leaderboard/tiny/Peg/tacff/seed0"
    checkpoint = save_tiny_checkpoint(run / "checkpoints/00000001")
    config = json.loads((checkpoint / "config.json").read_text()) | dict(env_id=PEG)
    (checkpoint / "config.json").write_text(json.dumps(config))
    bare = json.dumps(dict(render_backend="none", max_episode_steps=6))
    result = run / "00000001.json"
    evaluate.main(evaluate.Args(checkpoint, inference_steps=2, episodes=2, env_kwargs=bare, out=result))
    about = dict(name="Tiny", authors="Us", checkpoints={"Peg/tacff/seed0/00000001.json": published_hash(checkpoint)})
    (tmp_path / "leaderboard/tiny/submission.json").write_text(json.dumps(about))
    monkeypatch.chdir(tmp_path)
    again = evaluate.main(evaluate.Args(entry="tiny/Peg/tacff", episodes=2))
    assert config["inference_steps"] != read_result(again)["config"]["inference_steps"] == 2
    assert "2 of 2 episodes agree with those of the entry tiny/Peg/tacff" in caplog.text
    for changes, named in (
        (dict(env_kwargs='{"fit": "tight"}'), "env_kwargs"),
        (dict(inference_steps=3), "inference_steps"),
        (dict(policy_kwargs='{"seed": 1}'), "policy_kwargs"),
        (dict(stop_at_success=True), "stop_at_success"),
    ):
        caplog.clear()
        other = read_result(evaluate.main(evaluate.Args(entry="tiny/Peg/tacff", episodes=1, **changes)))
        assert f"not compared with those of the entry tiny/Peg/tacff, which was evaluated with other {named}" in caplog.text
        assert "agree" not in caplog.text
        assert other["env_kwargs"] == read_result(result)["env_kwargs"] | (dict(fit="tight") if named == "env_kwargs" else {})
    submission = read_submission(tmp_path / "leaderboard/tiny")
    rerun = run_again(submission, checkpoint_sources(submission, [checkpoint], "{}"), seed=0)
    assert [len(file.episodes) for file in rerun.files.values()] == [2]  # an outcome that differs would be an error


def test_an_entry_that_was_stopped_at_success_is_stopped_there_again(monkeypatch, tmp_path):
    result = find_entry(ENTRY).result
    for stops in (False, True):
        entry = Entry(ENTRY, result | dict(stop_at_success=stops), tmp_path)
        monkeypatch.setattr(evaluate, "find_entry", lambda _name, entry=entry: entry)
        asked = []
        monkeypatch.setattr(evaluate, "evaluation_from_args", lambda args, asked=asked: asked.append(args) or 1 / 0)
        with pytest.raises(ZeroDivisionError):
            evaluate.main(evaluate.Args(entry=ENTRY))
        assert asked[0].stop_at_success is stops
        assert dict(device=asked[0].device, batch_size=asked[0].batch_size) == result["inference"]
        assert asked[0].inference_steps == result["config"]["inference_steps"]


def test_an_entry_brings_its_own_checkpoint(tmp_path):
    with pytest.raises(ValueError, match="--entry brings its checkpoint"):
        evaluate.main(evaluate.Args(entry=ENTRY, checkpoint=tmp_path))


def test_checkpoints_that_a_killed_process_was_writing_are_left_out(tmp_path):
    whole = save_tiny_checkpoint(tmp_path / "checkpoints/00000001")
    partial = save_tiny_checkpoint(tmp_path / "checkpoints/.00000002.here-1-abc.partial")
    (partial / "config.json").unlink()
    assert checkpoints_in([tmp_path]) == {published_hash(whole): whole}
