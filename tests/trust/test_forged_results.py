"""Results that were copied or invented cannot reach the leaderboard cheaply."""

import json
import random
import shutil
from pathlib import Path

import numpy as np
import pytest

from manifeel_ms3.analysis.protocol import collect
from manifeel_ms3.evaluation.checkpoint_config import published_hash
from manifeel_ms3.evaluation.result import ResultError, summary_of
from manifeel_ms3.leaderboard.__main__ import Hash, Submit, main
from manifeel_ms3.leaderboard.checks import check
from manifeel_ms3.leaderboard.page import leaderboard_table, rows_on
from manifeel_ms3.leaderboard.rerun import chance_to_pass, draw, episodes_to_run_again
from manifeel_ms3.leaderboard.submission import SubmissionError, read_submission
from tests.leaderboard.made_up import made_up

from .files_of_strangers import rewrite_json
from .submissions import FIRST


def test_a16_one_evaluation_copied_thirty_times_is_refused(tmp_path):
    folder = made_up(tmp_path / "theirs", "Theirs", "PegInsertion", "rgb", 25, seeds=1, steps=1)
    for seed in range(3):
        for step in range(10):
            path = folder / f"results/{seed}/{step}.json"
            path.parent.mkdir(exist_ok=True)
            shutil.copy(folder / FIRST, path)
            rewrite_json(
                path,
                lambda result, seed=seed, step=step: (result.update(training_seed=seed), result["config"].update(step=step)),
            )
    (folder / FIRST).unlink()
    with pytest.raises(SubmissionError, match=r"has the outcomes of results/0/0.json in 100% of its episodes"):
        check(read_submission(folder))
    board = tmp_path / "board"
    shutil.copytree(folder, board / "theirs")
    assert rows_on(board) == []


def retold(source: Path, target: Path, jitter: float, changed: int) -> None:
    """The outcomes of one file in another one, but for small differences of force and some invented episodes."""
    theirs, rng = json.loads(source.read_text()), np.random.default_rng(1)

    def edit(result):
        result["episodes"] = theirs["episodes"]
        for k, episode in enumerate(result["episodes"]):
            other = float(rng.uniform(0.1, 1) if k < changed else rng.uniform(-jitter, jitter))
            episode["peak_contact_force"] += other
            episode["force_until_success"] = episode["peak_contact_force"] if episode["success_once"] else None
        result |= summary_of(result["episodes"], result["force_limit"])

    rewrite_json(target, edit)


@pytest.mark.parametrize(
    ("jitter", "changed", "is_copy"), [(0.015, 0, True), (0.0, 4, True), (0.0, 20, False), (2.0, 0, False)]
)
def test_a16_copies_with_small_changes_are_refused(folder, jitter, changed, is_copy):
    retold(folder / FIRST, folder / "results/1/00000200.json", jitter, changed)
    submission = read_submission(folder)
    if is_copy:
        with pytest.raises(SubmissionError, match="has the outcomes of"):
            check(submission)
    else:
        check(submission)  # running episodes again finds those


def test_a16_a_checkpoint_counts_once(folder):
    rewrite_json(folder / FIRST, lambda result: result["config"].update(step=200))
    submission = read_submission(folder)
    with pytest.raises(SubmissionError, match=r"2 results of .* are of training seed 0, step 200"):
        check(submission)
    with pytest.raises(ResultError, match=r"seed 0 and step 200: results/0/00000100.json, with 50 .*00000200.json, with 50;"):
        collect(submission.results)


@pytest.mark.parametrize(("total", "drawn"), [(1, 1), (20, 20), (50, 33), (150, 43), (500, 47), (1500, 49)])
def test_a16_so_many_episodes_are_run_again(total, drawn):
    assert episodes_to_run_again(total) == drawn
    if total > 20:
        assert chance_to_pass(total, -(-total // 10), episodes_to_run_again(total)) < 0.01


def test_a16_the_draw_is_from_all_files_and_finds_a_tenth_of_inventions(tmp_path):
    submission = read_submission(made_up(tmp_path / "theirs", "Theirs", "PegInsertion", "rgb", 10, seeds=3, steps=4))
    episodes = [(path, k) for path in submission.results for k in range(50)]
    invented = set(random.Random(7).sample(episodes, len(episodes) // 10))
    passed, files = 0, set()
    for seed in range(2000):
        drawn = draw(submission, None, seed)
        files |= set(drawn)
        chosen = {(path, k) for path, numbers in drawn.items() for k in numbers}
        assert len(chosen) == episodes_to_run_again(600)
        passed += not chosen & invented
    assert files == set(submission.results)
    assert passed <= 30  # 1 % of 2000 is 20, with a standard deviation of 4.5


def test_a16_each_row_of_the_page_is_drawn_from(tmp_path):
    folder = made_up(tmp_path / "theirs", "Theirs", "PegInsertion", "rgb", 10)
    other = made_up(tmp_path / "other", "Other", "ObjectSearch", "rgb", 30, seeds=1, steps=1)
    shutil.copytree(other / "results", folder / "results/search")
    drawn = draw(read_submission(folder), None, 0)
    assert sum(len(numbers) for path, numbers in drawn.items() if "search" in path.parts) == episodes_to_run_again(50)
    assert sum(len(numbers) for path, numbers in drawn.items() if "search" not in path.parts) == episodes_to_run_again(200)


def test_a16_a_submission_that_was_not_run_again_says_so(folder, tmp_path):
    (folder / "rerun.json").write_text(json.dumps(dict(seed=1, versions={}, files={})))  # the leaderboard's own, forged
    main(Submit(folder, rerun=0, board=tmp_path / "board"))
    assert not (tmp_path / "board/theirs/rerun.json").exists()
    (row,) = rows_on(tmp_path / "board")
    assert row.rerun_text == "no"
    assert "| no | Theirs |" in leaderboard_table([row])


def checkpoints_of(folder: Path, runs: Path) -> Path:
    """A checkpoint of every result, of other weights each."""
    for number, path in enumerate(sorted(folder.glob("results/*/*.json"))):
        config = json.loads(path.read_text())["config"]
        checkpoint = runs / f"{config['seed']}/checkpoints/{config['step']:08d}"
        checkpoint.mkdir(parents=True)
        (checkpoint / "config.json").write_text(json.dumps(config))
        (checkpoint / "model.safetensors").write_bytes(bytes([number]))
    return runs


def test_a16_results_are_of_the_checkpoints_that_the_submission_names(folder, tmp_path):
    runs = checkpoints_of(folder, tmp_path / "runs")
    submit = Submit(folder, checkpoint=(runs,), board=tmp_path / "board")
    with pytest.raises(SubmissionError, match=r"results/1/00000200.json: submission.json names no checkpoint"):
        main(submit)
    main(Hash(folder, checkpoint=(runs / "0", runs / "1")))
    about = json.loads((folder / "submission.json").read_text())
    one = runs / "1/checkpoints/00000200"
    assert about["checkpoints"]["results/1/00000200.json"] == published_hash(one)
    (one / "model.safetensors").write_bytes(b"other weights")
    with pytest.raises(SubmissionError, match=r"results/1/00000200.json: no given checkpoint has the hash"):
        main(submit)
    rewrite_json(
        folder / "submission.json",
        lambda about: about["checkpoints"].update({"results/1/00000200.json": published_hash(one)}),
    )
    rewrite_json(folder / "results/1/00000200.json", lambda result: result["config"].update(num_demos=10))
    with pytest.raises(SubmissionError, match=r"differ in \['num_demos'\]"):
        main(submit)
    assert not (tmp_path / "board").exists()


def test_a16_results_of_another_submission_are_refused(folder, tmp_path):
    board = tmp_path / "board"
    main(Submit(folder, rerun=0, board=board))
    mine = tmp_path / "mine"
    (mine / "x").mkdir(parents=True)
    shutil.copy(folder / FIRST, mine / "x")
    (mine / "submission.json").write_text(json.dumps(dict(name="Mine", authors="Me")))
    with pytest.raises(SubmissionError, match=rf"x/00000100.json has the outcomes of {board}/theirs/{FIRST} in 100%"):
        main(Submit(mine, rerun=0, board=board, check_only=True))
    shutil.rmtree(board / "theirs")
    main(Submit(mine, rerun=0, board=board))


@pytest.mark.parametrize(
    ("forged", "shown"),
    [
        (dict(policy="human"), "policy"),
        (dict(training_seed=7), "training_seed"),
        (dict(obs_mode="state", env_kwargs=dict(obs_mode="state", cameras=["wrist"])), "obs_mode"),
    ],
)
def test_a16_what_the_page_shows_is_what_the_checkpoint_says(folder, tmp_path, forged, shown):
    runs = checkpoints_of(folder, tmp_path / "runs")
    main(Hash(folder, checkpoint=(runs,)))
    rewrite_json(folder / FIRST, lambda result: result.update(forged))
    with pytest.raises(SubmissionError, match=rf"differ in \['{shown}'\]"):
        main(Submit(folder, checkpoint=(runs,), board=tmp_path / "board"))


@pytest.mark.parametrize("forged", [dict(num_demos=10), dict(lr=0.5), dict(taught_by="hand")], ids=str)
def test_a16_every_setting_of_a_result_is_that_of_its_checkpoint(folder, tmp_path, forged):
    runs = checkpoints_of(folder, tmp_path / "runs")
    main(Hash(folder, checkpoint=(runs,)))
    rewrite_json(folder / FIRST, lambda result: result["config"].update(forged))
    (name,) = forged
    with pytest.raises(SubmissionError, match=rf"differ in \['{name}'\]"):
        main(Submit(folder, checkpoint=(runs,), board=tmp_path / "board"))


def test_a16_one_checkpoint_cannot_stand_for_two_results(folder, tmp_path):
    runs = checkpoints_of(folder, tmp_path / "runs")
    main(Hash(folder, checkpoint=(runs,)))

    def edit(about):
        about["checkpoints"]["results/0/00000200.json"] = about["checkpoints"][FIRST]

    rewrite_json(folder / "submission.json", edit)
    with pytest.raises(SubmissionError, match=r"differ in \['step'\]"):
        main(Submit(folder, checkpoint=(runs,), board=tmp_path / "board"))
