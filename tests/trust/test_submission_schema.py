"""What a submission's form accepts can be shown, and everything else is refused in one way."""

import json
import re
import shutil
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from manifeel_ms3.errors import InvalidFileError
from manifeel_ms3.evaluation.result import ResultError
from manifeel_ms3.leaderboard.__main__ import Build, Submit, main
from manifeel_ms3.leaderboard.checks import check
from manifeel_ms3.leaderboard.page import rows_of, write_page
from manifeel_ms3.leaderboard.submission import SubmissionError, read_submission
from tests.leaderboard.made_up import made_up

from .files_of_strangers import rewrite_json
from .submissions import FIRST, NASTY, contents

# ------------------------------------------------------------------ what is accepted can be shown


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
    rewrite_json(folder / file, edit)
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
    rewrite_json(board / "foreign" / FIRST, lambda result: result.update(env_id="ManiFeel-Knitting-v1"))
    rewrite_json(board / "few" / FIRST, lambda result: result["episodes"].pop())
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
def test_fuzz_what_is_accepted_can_be_shown(small, tmp_path, examples, bounded_memory):
    outcomes = {True: 0, False: 0}

    @fuzz(examples)
    @given(st.lists(st.tuples(edits, junk), min_size=1, max_size=3))
    def tried(changes):
        files = {name: json.loads(content) for name, content in small.items()}
        for (file, place), value in changes:
            put(files[file], place, value)
        folder = written({name: json.dumps(content).encode() for name, content in files.items()}, tmp_path / "theirs")
        outcomes[accepted_and_shown(folder, tmp_path / "board")] += 1

    with bounded_memory("a damaged submission"):
        tried()
    assert min(outcomes.values()) > examples // 30, "both outcomes must be tried"


@counts
def test_fuzz_damaged_files_are_refused_or_shown(small, tmp_path, examples, bounded_memory):
    @fuzz(examples)
    @given(st.sampled_from(sorted(small)), st.data())
    def tried(name, data):
        content = bytearray(small[name])
        for _ in range(data.draw(st.integers(1, 3))):
            start = data.draw(st.integers(0, len(content)))
            content[start : start + data.draw(st.integers(0, 40))] = data.draw(st.binary(max_size=20))
        accepted_and_shown(written(small | {name: bytes(content)}, tmp_path / "theirs"), tmp_path / "board")

    with bounded_memory("a damaged submission"):
        tried()


@counts
def test_fuzz_any_folder_is_refused_in_one_way(tmp_path, examples, bounded_memory):
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

    with bounded_memory("a damaged submission"):
        tried()
