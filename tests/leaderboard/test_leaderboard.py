"""Submissions are checked, run again, ranked, and shown on a page that is tried in a browser."""

import base64
import html
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from manifeel_ms3.errors import FileExistsAlreadyError, InvalidArgumentError
from manifeel_ms3.evaluation import evaluate
from manifeel_ms3.evaluation.floors import highest_floor
from manifeel_ms3.evaluation.result import read_result, summary_of
from manifeel_ms3.leaderboard import __main__ as leaderboard
from manifeel_ms3.leaderboard.__main__ import Build, Submit, main
from manifeel_ms3.leaderboard.checks import check
from manifeel_ms3.leaderboard.page import rows_of, rows_on
from manifeel_ms3.leaderboard.rerun import draw, policy_sources, run_again
from manifeel_ms3.leaderboard.submission import SubmissionError, read_submission
from manifeel_ms3.tasks.registry import task_spec
from tests.browser import browser_program
from tests.leaderboard.made_up import made_up
from tests.tasks_and_marks import PEG
from tests.trust.files_of_strangers import rewrite_json

BROWSER = browser_program()
POLICY = "tests.evaluation.policies:StandStill"
BARE = json.dumps(dict(render_backend="none", max_episode_steps=3))


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory) -> Path:
    """A real result of all 50 initial states, with a few steps each."""
    out = tmp_path_factory.mktemp("evaluated") / "00000000.json"
    return evaluate.main(evaluate.Args(policy=POLICY, env_id=PEG, obs_mode="tacff", cameras=(), env_kwargs=BARE, out=out))


@pytest.fixture
def submission(evaluated, tmp_path) -> Path:
    folder = tmp_path / "still"
    folder.mkdir()
    (folder / "submission.json").write_text(json.dumps(dict(name="Still", authors="Nobody", link="https://example.org")))
    shutil.copy(evaluated, folder)
    return folder


def submit(folder: Path, board: Path, **changes) -> Path:
    return main(Submit(folder, policy=POLICY, board=board, **changes))


def test_a_submission_is_run_again_and_accepted(submission, tmp_path, monkeypatch):
    board = tmp_path / "board"
    taken = submit(submission, board, rerun=2)
    assert read_result(taken / "00000000.json")["policy"] == POLICY
    main(Build(board))
    assert "| 2 of 50 | [Still](https://example.org) |" in (board / "README.md").read_text()
    monkeypatch.setattr(leaderboard, "run_again", lambda *_: pytest.fail("episodes are run again for nothing"))
    with pytest.raises(FileExistsAlreadyError, match="rename"):
        submit(submission, board, rerun=1)


def change(folder: Path, edit) -> None:
    rewrite_json(folder / "00000000.json", edit)


@pytest.mark.parametrize(
    ("edit", "word"),
    [
        (lambda r: r["episodes"].pop(), "its 49 episodes are not those of the 50"),
        (lambda r: r["episodes"][3].update(seed=7), r"foreign \[7\]"),
        (lambda r: r.update(revision=99), "is of revision 99 of .* but the task has revision 4 here; evaluate again"),
        (lambda r: r["versions"].update(sapien="2.2.0"), "run with sapien 2.2.0, the leaderboard takes 3"),
        (lambda r: r["success_once"].update(rate=0.9), "success_once says"),
        (lambda r: r["episodes"][0].update(episode_len=900), "900 steps, the task ends after"),
        (lambda r: r["episodes"][0].update(success_at_end=True), "success at the end, but never"),
        (lambda r: r["episodes"][0].update(success_once=True, error="no idea"), "with the error no idea"),
        (lambda r: r["episodes"][0].update(peak_contact_force=1e4), "more than the arm can press with"),
        (lambda r: r["episodes"][0].update(episode_len=7), "from 3 to 7 steps, but one time limit"),
        (lambda r: r["episodes"][-1].update(first_success=3), "its first success is at step 3 of 3, with None N"),
        (
            lambda r: r["episodes"][0].update(force_until_success=400.0),
            "400.0 N until its first success",
        ),
        (lambda r: r["gentle_success"].update(rate=1.0), "gentle_success says"),
        (lambda r: r["success_paper"].update(rate=1.0), "success_paper says"),
        (lambda r: [episode.pop("success_paper") for episode in r["episodes"]], "success_paper says .* come to None"),
        (lambda r: r["episodes"][0].update(success_paper=True, error="no idea"), "with the error no idea"),
        (lambda r: r.update(stop_at_success=True), "evaluate without --stop-at-success"),
        (lambda r: r.update(episode_len=5.0), "episode_len says 5.0"),
        (lambda r: r.update(env_id="ManiFeel-Knitting-v1"), "is no task of this leaderboard"),
        (
            lambda r: r["env_kwargs"].update(sim_config=dict(sim_freq=10**9), num_envs=1),
            r"its env_kwargs have \['num_envs', 'sim_config'\], which change the simulator",
        ),
        (
            lambda r: r["env_kwargs"].update(sim_backend="physx_cuda"),
            "its env_kwargs have sim_backend 'physx_cuda'",
        ),
        (
            lambda r: r["env_kwargs"].update(tactile={"image_shape": [20000, 20000], "pixel_size": 1e-6}),
            "its tactile hold a number above 2048",
        ),
        (
            lambda r: r["env_kwargs"].update(sensor_configs=dict(wrist=dict(width=128, pose=[10**5]))),
            "its sensor_configs hold a number above 2048",
        ),
        (
            lambda r: r["env_kwargs"].update(max_episode_steps=10**9),
            "a time limit of 1000000000 steps, the task ends after 240",
        ),
        (lambda r: r.update(obs_mode="rgb"), "of obs_mode 'rgb', but its env_kwargs have obs_mode 'tacff'"),
        (lambda r: r["env_kwargs"].update(obs_mode="state"), "of obs_mode 'tacff', but its env_kwargs have obs_mode 'state'"),
        (lambda r: r["env_kwargs"].pop("obs_mode"), "its env_kwargs have obs_mode None"),
    ],
)
def test_what_is_wrong_with_a_result_is_said(submission, edit, word):
    change(submission, edit)
    with pytest.raises(SubmissionError, match=word):
        check(read_submission(submission))


def test_an_episode_that_goes_otherwise_is_found(submission, tmp_path):
    def lie(result):
        for episode in result["episodes"]:
            episode["episode_len"] = 2
        result["episode_len"] = 2.0

    change(submission, lie)
    with pytest.raises(SubmissionError, match="episode_len says 2, run again it is 3"):
        submit(submission, tmp_path / "board", rerun=1)
    assert not (tmp_path / "board").exists()


def test_a16_what_was_run_again_is_shown_and_counts_only_for_the_file_that_was_checked(submission, tmp_path, caplog):
    caplog.set_level("INFO")
    board = tmp_path / "board"
    taken = submit(submission, board, rerun=2)
    assert re.search(r"2 episodes of 1 results are run again, drawn with --seed \d{5,}", caplog.text)
    (row,) = rows_on(board)
    assert (row.rerun_text, row.is_confirmed) == ("2 of 50", False)
    assert len(json.loads((taken / "rerun.json").read_text())["files"]["00000000.json"]["episodes"]) == 2
    change(taken, lambda result: result.update(git_commit=None))  # edited by hand later
    (row,) = rows_on(board)
    assert row.rerun_text == "no"


def test_foreign_and_broken_files_are_all_named(submission, tmp_path):
    (submission / "other.json").write_text("{}")
    (submission / "broken.json").write_text("{")
    (submission / "submission.json").write_text('{"name": "x"}')
    with pytest.raises(SubmissionError) as error:
        read_submission(submission)
    for word in ("other.json has the schema None", "broken.json cannot be read", "submission.json: ", "authors"):
        assert word in str(error.value)


def test_a_result_of_another_policy_is_not_run_for_this_one(submission, tmp_path):
    with pytest.raises(SubmissionError, match=r"is not of tests\.evaluation\.policies:Raises, but of '.*StandStill'"):
        main(Submit(submission, policy="tests.evaluation.policies:Raises", board=tmp_path / "board"))


def test_a_policy_is_run_again_with_the_arguments_of_its_evaluation(submission, tmp_path):
    change(submission, lambda result: result["config"].update(policy_kwargs=dict(gain=0.3, api_key="(redacted)")))
    named = """was evaluated with --policy-kwargs '{"gain": 0.3, "api_key": "(redacted)"}', .* with '{}'; give the same"""
    with pytest.raises(SubmissionError, match=re.escape(named).replace(r"\.\*", ".*")):
        submit(submission, tmp_path / "board", rerun=1)
    given = json.dumps(dict(gain=0.3, api_key="1234567"))
    assert len(policy_sources(read_submission(submission), POLICY, given)) == 1


def test_a_server_with_a_password_is_asked_again(submission):
    change(submission, lambda result: result.update(policy="http://(redacted)@localhost:8000"))
    (source,) = policy_sources(read_submission(submission), "http://me:1234567@localhost:8000", "{}").values()
    assert source.policy == "http://me:1234567@localhost:8000"


def test_a_submission_needs_a_policy_from_the_command_line(submission, tmp_path):
    with pytest.raises(InvalidArgumentError, match="either --checkpoint or --policy"):
        main(Submit(submission, board=tmp_path / "board"))


def test_a_number_of_episodes_or_processes_that_is_not_possible_is_named(submission, tmp_path):
    for changes, named in ((dict(rerun=-1), "--rerun -1 must be at least 0"), (dict(workers=0), "--num-eval-envs 0 must be")):
        with pytest.raises(InvalidArgumentError, match=named):
            submit(submission, tmp_path / "board", **changes)


def test_the_policy_that_a_result_names_is_never_imported(submission, tmp_path):
    change(submission, lambda result: result.update(policy="this:Policy"))
    check(read_submission(submission))
    with pytest.raises(SubmissionError, match=r"is not of tests\.evaluation\.policies:StandStill, but of 'this:Policy'"):
        submit(submission, tmp_path / "board")
    assert "this" not in sys.modules


def test_a_result_of_version_1_is_refused_with_what_to_do(submission):
    change(submission, lambda result: result.update(schema="manifeel-evaluation-1"))
    with pytest.raises(SubmissionError, match=r"'manifeel-evaluation-1'.*evaluate the policy again"):
        read_submission(submission)


# -------------------------------------------------------------------- the page


@pytest.fixture(scope="module")
def board(tmp_path_factory) -> Path:
    board = tmp_path_factory.mktemp("board")
    for name, task, mode, won in (
        ("Alpha <b>", "PegInsertion", "rgb", 10),
        ("Beta", "PegInsertion", "rgb+tacff", 30),
        ("Gamma", "ObjectSearch", "rgb", 20),
    ):
        made_up(board / name[:2], name, task, mode, won)
    main(Build(board))
    return board


def test_the_table_ranks_within_a_task(board):
    lines = [line for line in (board / "README.md").read_text().splitlines() if line.startswith("| ObjectS") or "Peg" in line]
    assert [re.findall(r"(\d+)% \[", line)[0] for line in lines] == ["40", "60", "20"]
    assert "2 x 2 x 50" in lines[0]


def test_a_row_has_the_measures_of_the_episodes_of_its_success(tmp_path):
    """Of 10 x 50 episodes, 100 succeed, half of them gently; an earlier checkpoint than the last ten counts for nothing."""
    folder = made_up(tmp_path / "them", "Them", "PegInsertion", "rgb", 10, seeds=1, steps=11)
    limit, times = task_spec(PEG).force_limit, iter(range(-49, 501))

    def edit(result):
        early = result["config"]["step"] == 100
        for k, episode in enumerate(result["episodes"]):
            force = limit if k < 5 or early else limit + 0.001 if k < 10 else 7.0
            episode.update(peak_contact_force=force, inference_ms=float(max(next(times), 0)), success_at_end=k < 4)
            episode["force_until_success"] = force if k < 10 else None
        result |= summary_of(result["episodes"], limit)

    for path in sorted((folder / "results").rglob("*.json")):
        rewrite_json(path, edit)
    (row,) = rows_of(read_submission(folder))
    assert (row.success.value, row.gentle, row.results.success_at_end) == (0.2, 0.1, 0.08)
    assert (row.force, row.inference_ms, row.rerun) == (7.0, 250.5, (0, 550))
    assert (row.is_full, row.is_confirmed) == (False, False)
    assert row.floor == highest_floor(PEG, task_spec(PEG).revision)


def test_results_of_an_earlier_revision_are_left_out_and_the_others_of_their_submission_stay(tmp_path, caplog):
    folder = made_up(tmp_path / "ours", "Ours", "PegInsertion", "rgb", 10)
    for path in (folder / "results/1").iterdir():
        rewrite_json(path, lambda result: result.update(revision=1))
    (row,) = rows_on(tmp_path)
    assert row.results.success.shape == (1, 2, 50)
    (message,) = caplog.messages
    assert re.fullmatch(rf"left out: 2 results in .*ours: they are of revision 1 of {PEG}, but the task has .* here", message)
    shutil.rmtree(folder / "results/0")
    assert rows_on(tmp_path) == []


def test_a_row_shows_the_video_of_its_own_results_and_those_of_the_whole_submission(tmp_path):
    folder = made_up(tmp_path / "us", "Us", "PegInsertion", "rgb", 10)
    (folder / "results").rename(folder / "of_peg")
    shutil.copytree(made_up(tmp_path / "other", "Other", "ObjectSearch", "rgb", 20) / "results", folder / "of_search")
    shutil.rmtree(tmp_path / "other")
    (folder / "videos/notes").mkdir(parents=True)
    for name in ("of_peg", "of_search", "notes/all"):
        (folder / f"videos/{name}.mp4").write_bytes(name.encode())
    (folder / "videos/not_a_video.txt").write_bytes(b"text")
    main(Build(tmp_path))
    page = (tmp_path / "index.html").read_text()
    _, search, peg = page.split('<tr class="row"')  # in the order of the tasks
    videos = [[base64.b64decode(one).decode() for one in re.findall('video/mp4;base64,([^"]+)', row)] for row in (search, peg)]
    assert videos == [["notes/all", "of_search"], ["notes/all", "of_peg"]]


def browsed(board: Path, address: str) -> str:
    """The html of the page after a browser has run its scripts."""
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=4000", "--dump-dom"]
    url = f"file://{board}/index.html#{address}"
    return subprocess.run([*command, url], capture_output=True, text=True, timeout=120, check=True).stdout


def shown(board: Path, address: str) -> list[str]:
    """Names of the visible rows, in their order."""
    rows = re.findall(r'<tr class="row"[^>]*>', browsed(board, address))
    return [html.unescape(re.findall(r'data-name="([^"]*)"', row)[0]) for row in rows if "hidden" not in row]


@pytest.mark.skipif(BROWSER is None, reason="no browser on this machine")
def test_the_page_sorts_filters_and_searches_in_a_browser(board):
    assert shown(board, "") == ["Gamma", "Beta", "Alpha <b>"]
    assert shown(board, "sort=success") == ["Alpha <b>", "Gamma", "Beta"]
    assert shown(board, "task=PegInsertion&sort=-name") == ["Beta", "Alpha <b>"]
    assert shown(board, "sensing=rgb%2Btacff") == ["Beta"]
    assert shown(board, "search=gamma") == ["Gamma"]


@pytest.mark.skipif(BROWSER is None, reason="no browser on this machine")
def test_a_row_opens_with_its_curves(board):
    assert '<svg class="main-svg"' not in browsed(board, "task=ObjectSearch")
    page = browsed(board, "task=ObjectSearch&open=0")
    assert page.count('<g class="trace scatter') == 2  # one a training seed


def test_the_page_needs_nothing_else(board):
    page = (board / "index.html").read_text()
    assert not re.search(r'<(script|link|img)[^>]+(src|href)="https?:', page)
    assert "Alpha &lt;b&gt;" in page


def test_no_leaderboard_is_built_where_there_is_none(tmp_path):
    with pytest.raises(InvalidArgumentError, match="is no folder; give that of a leaderboard"):
        main(Build(tmp_path / "leaderboard"))
    assert not list(tmp_path.iterdir())


def test_the_episodes_that_are_run_again_are_those_that_were_drawn(submission):
    read = read_submission(submission)
    (path,) = read.results
    seeds = [episode["seed"] for episode in read.results[path]["episodes"]]
    seed, drawn = next((seed, found) for seed in range(100) if min(found := draw(read, 2, seed)[path]) > 1)
    ran = run_again(read, policy_sources(read, POLICY, "{}"), 2, seed)
    assert ran.files[path.as_posix()].episodes == [seeds[k] for k in drawn]
