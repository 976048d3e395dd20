"""A submission comes from a stranger: nothing but its own files reaches the leaderboard, whole or not at all; its texts stay
texts; its results cannot be forged cheaply; and whatever is accepted can be shown.

The letters are those of the findings of the review that found the faults.
"""

import html
import json
import os
import random
import re
import shutil
import signal
import time
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from manifeel_ms3.analysis.protocol import collect
from manifeel_ms3.errors import FileExistsAlreadyError, InUseError, InvalidFileError
from manifeel_ms3.evaluation.result import ResultError, summary_of
from manifeel_ms3.leaderboard import untrusted
from manifeel_ms3.leaderboard.__main__ import Build, Hash, Submit, main
from manifeel_ms3.leaderboard.checks import check
from manifeel_ms3.leaderboard.page import leaderboard_table, rows_of, rows_on, write_page
from manifeel_ms3.leaderboard.rerun import chance_to_pass, checkpoint_sha256, draw, episodes_to_run_again
from manifeel_ms3.leaderboard.submission import SubmissionError, read_submission
from manifeel_ms3.leaderboard.taking import take
from manifeel_ms3.leaderboard.text import is_safe_link, markdown_text
from manifeel_ms3.ownership import owned
from tests.leaderboard.made_up import made_up

FIRST = "results/0/00000100.json"


@pytest.fixture
def folder(tmp_path) -> Path:
    return made_up(tmp_path / "theirs", "Theirs", "PegInsertion", "rgb", 10)


def change(path: Path, edit) -> None:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# ------------------------------------------------------------------ A10: whole or not at all


def taken_until_killed(folder: Path, board: Path, files: int, delay: float) -> bool:
    """Take a submission in a process that is killed a moment after so many files are written; whether it was at work still."""
    submission = read_submission(folder)
    if (child := os.fork()) == 0:
        try:
            take(submission, board)
        finally:
            os._exit(0)
    ended = (0, 0)
    while not ended[0] and sum(len(names) for _, _, names in os.walk(board / ".incoming")) < files:
        ended = os.waitpid(child, os.WNOHANG)
    time.sleep(delay)
    if not ended[0]:
        os.kill(child, signal.SIGKILL)
        ended = os.waitpid(child, 0)
    return ended[1] == signal.SIGKILL


@pytest.mark.parametrize("kills", [6, pytest.param(100, marks=pytest.mark.slow)])
def test_a10_a_submission_that_is_killed_while_it_is_taken_is_whole_or_absent(tmp_path, kills, figure):
    folder = made_up(tmp_path / "theirs", "Theirs", "PegInsertion", "rgb", 10, seeds=3, steps=3)
    expected, rng, killed, whole = contents(folder), random.Random(0), 0, 0
    for number in range(kills):
        board = tmp_path / f"board{number}"
        killed += taken_until_killed(folder, board, rng.randint(0, len(expected)), rng.uniform(0, 0.003))
        if (board / "theirs").exists():
            whole += 1
            assert contents(board / "theirs") == expected
            with pytest.raises(FileExistsAlreadyError):
                take(read_submission(folder), board)
        else:
            assert rows_on(board) == []
            assert contents(take(read_submission(folder), board)) == expected
        assert len(rows_on(board)) == 1
        assert not (board / ".incoming").exists()
    figure(f"of {kills} processes killed while they take a submission, number hit at work", killed, at_least=kills // 3)
    figure(f"of {kills} processes killed while they take a submission, number that left it whole", whole, at_least=0)


def test_a10_a_copy_that_fails_leaves_nothing(folder, tmp_path):
    board = tmp_path / "board"
    (board / ".incoming").mkdir(parents=True)  # what a killed copy has left
    (board / ".incoming/results").write_text("in the way")
    submission = read_submission(folder)
    with owned(board / ".incoming"), pytest.raises(InUseError, match="in use by process"):
        take(submission, board)
    assert contents(take(submission, board)) == contents(folder)


def test_a10_only_what_was_checked_is_taken(folder, tmp_path):
    (folder / "notes.txt").write_text("not for the board")
    (folder / "results/a.mp4").write_bytes(b"not in videos")
    submission = read_submission(folder)
    (folder / FIRST).write_text("exchanged after the check")
    taken = contents(take(submission, tmp_path / "board"))
    assert set(taken) == {"submission.json", *(path.as_posix() for path in submission.results)}
    assert b"exchanged" not in taken[FIRST]
    odd = read_submission(shutil.copytree(tmp_path / "board/theirs", tmp_path / "a | b"))
    with pytest.raises(SubmissionError, match="rename the folder"):
        take(odd, tmp_path / "board")


# ------------------------------------------------------------------ A14: its own regular files only


def link_to_a_secret(folder: Path, secret: Path) -> None:
    (folder / "videos").mkdir()
    (folder / "videos/a.mp4").symlink_to(secret)


def link_to_a_folder(folder: Path, secret: Path) -> None:
    (folder / "videos").symlink_to(secret.parent)


def link_in_a_folder(folder: Path, secret: Path) -> None:
    (folder / "results/9").symlink_to(secret.parent, target_is_directory=True)


def broken_link(folder: Path, secret: Path) -> None:
    (folder / "more.json").symlink_to("nowhere")


def pipe(folder: Path, secret: Path) -> None:
    os.mkfifo(folder / "endless.json")


@pytest.mark.parametrize("harm", [link_to_a_secret, link_to_a_folder, link_in_a_folder, broken_link, pipe])
def test_a14_links_and_special_files_are_refused(folder, tmp_path, harm):
    secret = tmp_path / "mine/secret.mp4"
    secret.parent.mkdir()
    secret.write_bytes(b"PRIVATE KEY")
    harm(folder, secret)
    with pytest.raises(SubmissionError, match="symbolic link or a special file"):
        main(Submit(folder, rerun=0, board=tmp_path / "board"))
    assert not (tmp_path / "board").exists()
    board = tmp_path / "by_hand"  # somebody has put it into the leaderboard by hand
    board.mkdir()
    folder.rename(board / "theirs")
    page = main(Build(board))
    assert b"PRIVATE KEY" not in page.read_bytes()
    assert "Theirs" not in page.read_text()


def test_a14_a_linked_folder_is_no_submission(folder, tmp_path):
    (tmp_path / "link").symlink_to(folder)
    with pytest.raises(SubmissionError, match="give the folder itself"):
        read_submission(tmp_path / "link")
    board = tmp_path / "board"
    board.mkdir()
    (board / "theirs").symlink_to(folder)
    assert rows_on(board) == []


def test_a14_files_have_a_limit_of_size(folder, tmp_path, monkeypatch):
    (folder / "videos").mkdir()
    with (folder / "videos/a.mp4").open("wb") as file:
        file.truncate(2**40)  # takes no room on the disk
    with pytest.raises(SubmissionError, match="more than 16 MiB"):
        read_submission(folder)
    (folder / "videos/a.mp4").unlink()
    (folder / "padded.json").write_text(" " * (2**20 + 1))
    with pytest.raises(SubmissionError, match="more than 1 MiB"):
        read_submission(folder)
    (folder / "padded.json").unlink()
    for name, most, word in (("MOST_ENTRIES", 5, "more than 5 files"), ("LARGEST_TOTAL", 9, "leave some videos out")):
        with monkeypatch.context() as limited:
            limited.setattr(untrusted, name, most)
            with pytest.raises(SubmissionError, match=word):
                read_submission(folder)
    deep = folder / "/".join("d" * 300)
    deep.mkdir(parents=True)
    with pytest.raises(SubmissionError, match="nested deeper than 8"):
        read_submission(folder)


# ------------------------------------------------------------------ A15: texts stay texts

NASTY = "<img src=x onerror=alert(1)>|`*_[a](javascript:alert(2))~~$x$ &lt; \\| **b**"


@pytest.mark.parametrize("text", ["a\nb", "a\rb", "a\u2028b", "a\u202eb", "a\x00b", "a\u200bb", " ", ""])
def test_a15_name_and_authors_are_one_line(folder, text):
    for name in ("name", "authors"):
        change(folder / "submission.json", lambda about, name=name: about.update({name: text}))
        with pytest.raises(SubmissionError, match=name):
            read_submission(folder)
        change(folder / "submission.json", lambda about, name=name: about.update({name: "x"}))


@pytest.mark.parametrize(
    "link",
    [
        "javascript:alert(1)",
        "JaVaScRiPt:alert(1)//https://a.b",
        "data:text/html,x",
        "//example.org",
        "ftp://example.org",
        "file:///etc/passwd",
        "https://user:password@example.org",
        "https://user@example.org",
        "https://",
        "https:///path",
        "https://a.b/) | 100 % |",
        "https://a.b/\n| row |",
        "https://a.b/\n",
        "https://a.b/<script>",
        'https://a.b/"onclick="x',
        "https://a.b:99999999/",
        "https://a.b:x/",
        " https://a.b",
    ],
)
def test_a15_only_plain_web_addresses_are_links(folder, link):
    assert not is_safe_link(link)
    change(folder / "submission.json", lambda about: about.update(link=link))
    with pytest.raises(SubmissionError, match="the link must be an address"):
        read_submission(folder)


class Tags(HTMLParser):
    """Tags of a page with their attributes, without the scripts' contents."""

    def __init__(self, text: str):
        super().__init__()
        self.found: list[tuple[str, dict]] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))


def test_a15_texts_of_a_submission_are_no_markup(folder, tmp_path):
    change(
        folder / "submission.json",
        lambda about: about.update(name=NASTY, authors=NASTY, link="https://example.org/a_b?c=d&e=*f*#g"),
    )
    for path in folder.glob("results/*/*.json"):
        change(
            path,
            lambda result: result.update(
                policy=NASTY + "\n| forged | row |",
                obs_mode="rgb+tacrgb" + NASTY,
                env_kwargs=dict(cameras=[NASTY], fit=NASTY),
                config=result["config"] | dict(policy=dict(encoder=dict(image=NASTY[:90], tacrgb=NASTY[:90]))),
            ),
        )
    board = tmp_path / "board"
    main(Submit(folder, rerun=0, board=board))
    main(Build(board))
    lines = [line for line in (board / "README.md").read_text().splitlines() if line.startswith("|")]
    assert len(lines) == 3
    unescaped = [re.findall(r"(?<!\\)[|`*_<>~]", re.sub(r"\]\(https://[^)]*\)", "]", line)) for line in lines]
    assert unescaped[2] == ["|"] * 12
    assert re.findall(r"(?<!\\)\]\(([^)]*)", lines[2]) == ["https://example.org/a_b?c=d&e=*f*#g"]
    page = (board / "index.html").read_text()
    tags = Tags(re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)).found
    assert not [tag for tag, attrs in tags if tag in ("img", "b") and "style" not in attrs]
    assert not [name for _, attrs in tags for name in attrs if name.startswith("on")]
    assert [attrs["href"] for tag, attrs in tags if tag == "a"] == ["https://example.org/a_b?c=d&e=*f*#g"]
    assert html.escape(NASTY, quote=False).split()[0] in page


@given(st.text(max_size=60))
@settings(max_examples=300, deadline=None, derandomize=True)
def test_a15_a_cell_of_the_table_has_no_markup(text):
    cell = markdown_text(text)
    assert cell.isprintable()
    assert not re.search(r"(?<!\\)[`*_\[\]{}]", cell.replace("\\\\", ""))
    assert not re.search(r"[<>|~$]|&(?!#\d+;)", cell)


# ------------------------------------------------------------------ A16: results cannot be forged cheaply


def test_a16_one_evaluation_copied_thirty_times_is_refused(tmp_path):
    folder = made_up(tmp_path / "theirs", "Theirs", "PegInsertion", "rgb", 25, seeds=1, steps=1)
    for seed in range(3):
        for step in range(10):
            path = folder / f"results/{seed}/{step}.json"
            path.parent.mkdir(exist_ok=True)
            shutil.copy(folder / FIRST, path)
            change(
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

    change(target, edit)


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
    change(folder / FIRST, lambda result: result["config"].update(step=200))
    submission = read_submission(folder)
    with pytest.raises(SubmissionError, match=r"2 results of .* are of training seed 0, step 200"):
        check(submission)
    with pytest.raises(ResultError, match="training seed 0 and step 200; leave one of them out"):
        collect(submission.results.values())


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
    assert about["checkpoints"]["results/1/00000200.json"] == checkpoint_sha256(one)
    (one / "model.safetensors").write_bytes(b"other weights")
    with pytest.raises(SubmissionError, match=r"results/1/00000200.json: no given checkpoint has the hash"):
        main(submit)
    change(
        folder / "submission.json",
        lambda about: about["checkpoints"].update({"results/1/00000200.json": checkpoint_sha256(one)}),
    )
    change(folder / "results/1/00000200.json", lambda result: result["config"].update(num_demos=10))
    with pytest.raises(SubmissionError, match=r"differ in \['num_demos'\]"):
        main(submit)
    assert not (tmp_path / "board").exists()


def test_a16_one_checkpoint_cannot_stand_for_two_results(folder, tmp_path):
    runs = checkpoints_of(folder, tmp_path / "runs")
    main(Hash(folder, checkpoint=(runs,)))

    def edit(about):
        about["checkpoints"]["results/0/00000200.json"] = about["checkpoints"][FIRST]

    change(folder / "submission.json", edit)
    with pytest.raises(SubmissionError, match=r"differ in \['step'\]"):
        main(Submit(folder, checkpoint=(runs,), board=tmp_path / "board"))


# ------------------------------------------------------------------ A17 to A19: what is accepted can be shown


@pytest.mark.parametrize(
    ("file", "edit"),
    [
        ("submission.json", lambda about: about.update(link=None)),
        ("submission.json", lambda about: about.update(link=5)),
        ("submission.json", lambda about: about.update(name=["x"])),
        ("submission.json", lambda about: about.update(note="more")),
        ("submission.json", lambda about: about.update(checkpoints={"nowhere.json": "0" * 64})),
        ("submission.json", lambda about: about.update(checkpoints={FIRST: "abc"})),
        (FIRST, lambda result: result["config"].update(num_demos=[1])),
        (FIRST, lambda result: result["config"].update(policy="text")),
        (FIRST, lambda result: result["config"].update(policy=dict(encoder=[]))),
        (FIRST, lambda result: result["config"].update(step="10")),
        (FIRST, lambda result: result["env_kwargs"].update(cameras=5)),
        (FIRST, lambda result: result["env_kwargs"].update(cameras=[[]])),
        (FIRST, lambda result: result.update(obs_mode="x" * 1000)),
        (FIRST, lambda result: result.update(more=1)),
        (FIRST, lambda result: result["episodes"][0].update(more=1)),
    ],
)
def test_a17_the_form_is_checked_before_anything_is_copied(folder, tmp_path, file, edit):
    change(folder / file, edit)
    with pytest.raises(SubmissionError, match=re.escape(file)):
        main(Submit(folder, rerun=0, board=tmp_path / "board"))
    assert not (tmp_path / "board").exists()


def test_a17_build_names_a_broken_submission_and_shows_the_others(folder, tmp_path, caplog):
    board = tmp_path / "board"
    main(Submit(folder, rerun=0, board=board))
    for name in ("empty", "broken", "foreign", "few"):
        shutil.copytree(folder, board / name)
    shutil.rmtree(board / "empty/results")
    (board / "broken" / FIRST).write_text("{")
    change(board / "foreign" / FIRST, lambda result: result.update(env_id="ManiFeel-Knitting-v1"))
    change(board / "few" / FIRST, lambda result: result["episodes"].pop())
    (board / "rubbish").mkdir()
    (board / "file.txt").write_text("no submission")
    page = main(Build(board))
    assert page.read_text().count('<tr class="row"') == 1
    left_out = [message for message in caplog.messages if message.startswith("left out: ")]
    assert len(left_out) == 5
    for name in ("empty", "broken", "foreign", "few", "rubbish"):
        (message,) = (message for message in left_out if f"board/{name} cannot" in message)
        assert "\n" not in message


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e400", "-1e999"])
@pytest.mark.parametrize("place", ["peak_contact_force", "inference_ms", "episode_len", "rate", "num_demos"])
def test_a18_numbers_are_finite(folder, number, place):
    text = (folder / FIRST).read_text()
    (folder / FIRST).write_text(re.sub(rf'"{place}": [\d.]+', f'"{place}": {number}', text, count=1))
    assert (folder / FIRST).read_text() != text
    with pytest.raises(SubmissionError, match=rf"{FIRST} (cannot be read as json|has a number)"):
        read_submission(folder)


@pytest.mark.parametrize(
    "content",
    [
        b"[" * 100_000 + b"]" * 100_000,
        b'{"a":' * 900 + b"1" + b"}" * 900,
        b'{"seed": ' + b"9" * 5000 + b"}",
        b'{"seed": ' + b"9" * 4000 + b"}",
        b'{"name": "\xff\xfe"}',
        b"\xff\xfe{\x00}\x00",
        b'{"name": "\\ud800"}',
        b"",
        b"5",
        b"null",
        b"[]",
        b"\x00" * 100,
    ],
)
def test_a19_whatever_a_file_holds_it_is_refused_in_one_way(folder, content):
    for name in ("submission.json", FIRST, "rerun.json"):
        before = (folder / name).read_bytes() if (folder / name).exists() else None
        (folder / name).write_bytes(content)
        with pytest.raises(SubmissionError, match=re.escape(name)):
            read_submission(folder)
        (folder / name).unlink() if before is None else (folder / name).write_bytes(before)


# ------------------------------------------------------------------ whatever is accepted can be shown

junk = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=20), st.sampled_from(["rgb", "", NASTY])),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=6,
)
PLACES = {
    "submission.json": [("name",), ("authors",), ("link",), ("checkpoints",), ("other",), ("checkpoints", FIRST)],
    FIRST: [
        *(
            (name,)
            for name in ("obs_mode", "policy", "training_seed", "config", "env_kwargs", "machine", "versions", "episodes")
        ),
        *(("config", name) for name in ("step", "num_demos", "policy", "seed", "anything")),
        ("config", "policy", "encoder"),
        ("config", "policy", "encoder", "image"),
        *(("env_kwargs", name) for name in ("cameras", "fit", "obs_mode")),
        ("success_once", "rate"),
        ("episode_len",),
        *(
            ("episodes", 3, name)
            for name in ("seed", "success_once", "first_success", "episode_len", "force_until_success", "error")
        ),
    ],
}
edits = st.sampled_from([(file, place) for file, places in PLACES.items() for place in places])


def put(content, place: tuple, value) -> None:
    """Put a value into a place of a tree, unless an earlier change has removed the place."""
    for name in place[:-1]:
        if isinstance(content, dict):
            content = content.setdefault(name, {})
        elif isinstance(content, list) and name in range(len(content)):
            content = content[name]
        else:
            return
    if isinstance(content, dict) or (isinstance(content, list) and place[-1] in range(len(content))):
        content[place[-1]] = value


def accepted_and_shown(folder: Path, board: Path) -> bool:
    """Whether a submission is accepted; then it can be shown."""
    try:
        submission = read_submission(folder)
        check(submission)
    except (SubmissionError, ResultError):
        return False
    rows = rows_of(submission)
    write_page(rows, board)
    assert len([line for line in (board / "README.md").read_text().splitlines() if line.startswith("|")]) == 2 + len(rows)
    return True


def fuzz(examples: int):
    return settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> dict[str, bytes]:
    return contents(made_up(tmp_path_factory.mktemp("small") / "x", "Theirs", "PegInsertion", "rgb", 10, seeds=1, steps=1))


def written(files: dict[str, bytes], folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


counts = pytest.mark.parametrize("examples", [300, pytest.param(10_000, marks=pytest.mark.slow)])


@counts
def test_fuzz_what_is_accepted_can_be_shown(small, tmp_path, examples):
    outcomes = {True: 0, False: 0}

    @fuzz(examples)
    @given(st.lists(st.tuples(edits, junk), min_size=1, max_size=3))
    def tried(changes):
        files = {name: json.loads(content) for name, content in small.items()}
        for (file, place), value in changes:
            put(files[file], place, value)
        folder = written({name: json.dumps(content).encode() for name, content in files.items()}, tmp_path / "theirs")
        outcomes[accepted_and_shown(folder, tmp_path / "board")] += 1

    tried()
    assert min(outcomes.values()) > examples // 30, "both outcomes must be tried"


@counts
def test_fuzz_damaged_files_are_refused_or_shown(small, tmp_path, examples):
    @fuzz(examples)
    @given(st.sampled_from(sorted(small)), st.data())
    def tried(name, data):
        content = bytearray(small[name])
        for _ in range(data.draw(st.integers(1, 3))):
            start = data.draw(st.integers(0, len(content)))
            content[start : start + data.draw(st.integers(0, 40))] = data.draw(st.binary(max_size=20))
        accepted_and_shown(written(small | {name: bytes(content)}, tmp_path / "theirs"), tmp_path / "board")

    tried()


@counts
def test_fuzz_any_folder_is_refused_in_one_way(tmp_path, examples):
    @fuzz(examples)
    @given(
        st.dictionaries(
            st.sampled_from(["submission.json", "a.json", "b/c.json", "rerun.json", "videos/d.mp4", "e"]),
            st.one_of(st.binary(max_size=30), junk.map(lambda value: json.dumps(value).encode())),
        )
    )
    def tried(files):
        (tmp_path / "theirs").mkdir(exist_ok=True)
        with pytest.raises(InvalidFileError):
            read_submission(written(files, tmp_path / "theirs"))

    tried()
