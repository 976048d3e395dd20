"""Training loses nothing when it is killed or its folder is in use, and imports nothing from the current folder."""

import json
import os
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from baselines.common.checkpoint import (
    TRAINING_STATE,
    WEIGHTS,
    make_last,
    newest_checkpoint,
    pack,
    prune,
    random_state,
    read_tensors,
    save_checkpoint,
    saved_checkpoints,
    unpack,
)
from baselines.common.run_log import entries_until
from manifeel_ms3.errors import FileExistsAlreadyError, InUseError, InvalidArgumentError
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError
from manifeel_ms3.files import FileWriteError
from tests.trust.tiny_training import STEPS, finished, require_whole, start, tiny_args, train

REPOSITORY = Path(__file__).parents[2]
PATIENCE = 120  # s


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> tuple[Path, float]:
    """Folder of a run that nothing disturbed, and how long it took once everything was imported, in s."""
    folder = tmp_path_factory.mktemp("runs")
    finished(tiny_args(folder / "first"))  # the server imports everything
    return folder / "first", finished(tiny_args(folder / "second"))


def steps_on_board(run_dir: Path) -> list[int]:
    board = EventAccumulator(str(run_dir), size_guidance=dict(scalars=0))
    return [event.step for event in board.Reload().Scalars("losses/total_loss")]


def require_equal(run_dir: Path, other: Path) -> None:
    """Weights, the state of training and the log are the same, and every step is logged once."""
    for name in (WEIGHTS, TRAINING_STATE):
        one, two = (read_tensors(folder / "checkpoints/last" / name) for folder in (run_dir, other))
        assert one.keys() == two.keys()
        assert all(torch.equal(one[key], two[key]) for key in one)
    assert (run_dir / "log.jsonl").read_text() == (other / "log.jsonl").read_text()
    steps = [json.loads(line)["step"] for line in (run_dir / "log.jsonl").read_text().splitlines()]
    assert steps == list(range(1, STEPS + 1))
    assert steps_on_board(run_dir) == steps
    assert sorted(path.name for path in (run_dir / "checkpoints").iterdir()) == ["00000036", "00000038", "00000040", "last"]


# -------------------------------------------------------------------- killed


@pytest.mark.parametrize("kills", [5, pytest.param(100, marks=pytest.mark.slow)])
def test_a02_training_goes_on_wherever_it_is_killed(kills, undisturbed, tmp_path, figure):
    whole, seconds = undisturbed
    moments = random.Random(kills)
    killed, resumed, runs = 0, 0, 0
    while killed < kills:
        run_dir = tmp_path / str(runs)
        runs += 1
        while True:
            resume = bool(saved_checkpoints(run_dir / "checkpoints"))
            resumed += resume
            process = start(tiny_args(run_dir, resume=resume))
            if killed == kills:
                break
            process.join(moments.uniform(0, seconds))
            if process.exitcode is not None:
                break
            process.kill()
            process.join()
            killed += 1
            last = run_dir / "checkpoints/last"
            if last.is_symlink():
                require_whole(last)
        process.join(PATIENCE)
        assert process.exitcode == 0
        require_equal(run_dir, whole)
    figure("kills of training", killed, at_least=kills)
    figure("resumptions of training after a kill", resumed, at_least=1)


@pytest.mark.parametrize("linked", [None, "00000038"])
def test_a02_a_checkpoint_that_was_not_made_the_last_one_counts(linked, undisturbed, tmp_path):
    """As after a kill between the checkpoint and the link: after the first one, and after a later one."""
    shutil.copytree(undisturbed[0], tmp_path / "run", symlinks=True)
    checkpoints = tmp_path / "run/checkpoints"
    (checkpoints / "last").unlink()
    if linked:
        make_last(checkpoints / linked)
    with pytest.raises(FileExistsAlreadyError):
        train(tiny_args(tmp_path / "run"))
    assert require_whole(train(tiny_args(tmp_path / "run", resume=True))) == STEPS
    require_equal(tmp_path / "run", undisturbed[0])


def test_b06_a_broken_state_of_training_is_told_with_what_is_left_to_do(undisturbed, tmp_path):
    shutil.copytree(undisturbed[0], tmp_path / "run", symlinks=True)
    state = tmp_path / "run/checkpoints/last" / TRAINING_STATE
    state.write_bytes(state.read_bytes()[:100])
    with pytest.raises(
        CheckpointError, match=r"training.safetensors cannot be read .*; older checkpoints .* anew with --overwrite"
    ):
        train(tiny_args(tmp_path / "run", resume=True))


def test_b06_what_was_logged_after_the_checkpoint_does_not_stay(tmp_path):
    """A run that was killed long after its last checkpoint, in the middle of a line of the log."""
    run_dir, saved = tmp_path / "run", STEPS - 10
    train(tiny_args(run_dir, steps=saved))
    lines = (run_dir / "log.jsonl").read_text().splitlines()
    with (run_dir / "log.jsonl").open("a") as log:
        for step in range(saved + 1, saved + 6):
            log.write(json.dumps(dict(step=step, loss=99.0)) + "\n")
        log.write('{"step": 3')
    train(tiny_args(run_dir, resume=True))
    after = (run_dir / "log.jsonl").read_text().splitlines()
    assert after[:saved] == lines
    assert [json.loads(line)["step"] for line in after] == list(range(1, STEPS + 1)) == steps_on_board(run_dir)
    assert all(json.loads(line)["losses/total_loss"] < 99 for line in after)


def test_b06_no_log_is_an_empty_one(tmp_path):
    assert entries_until(tmp_path / "log.jsonl", 5) == []
    (tmp_path / "log.jsonl").write_bytes(b'[1]\n{"losses/total_loss": 1}\n\xff\xfe\n{"step": 2}\n{"step": 6}\n')
    assert entries_until(tmp_path / "log.jsonl", 5) == [dict(step=2)]


# -------------------------------------------------------------------- the folder of a run


def test_a02_a_folder_with_checkpoints_is_refused_and_stays_as_it_is(undisturbed, tmp_path):
    run_dir = tmp_path / "run"
    shutil.copytree(undisturbed[0], run_dir, symlinks=True)
    before = {path: path.stat().st_mtime_ns for path in run_dir.rglob("*")}
    with pytest.raises(FileExistsAlreadyError, match="earlier run; continue it with --resume, replace it with --overwrite"):
        train(tiny_args(run_dir, steps=4))
    assert {path: path.stat().st_mtime_ns for path in run_dir.rglob("*")} == before
    (run_dir / "evaluations").mkdir()
    (run_dir / "evaluations/00000040.json").write_text("{}")
    (run_dir / "evaluation.json").write_text("{}")
    (run_dir / "notes.txt").write_text("mine")
    assert require_whole(train(tiny_args(run_dir, steps=4, overwrite=True))) == 4
    assert sorted(path.name for path in (run_dir / "checkpoints").iterdir()) == ["00000002", "00000004", "last"]
    assert steps_on_board(run_dir) == [1, 2, 3, 4]
    assert not (run_dir / "evaluations").exists()
    assert not (run_dir / "evaluation.json").exists()
    assert (run_dir / "notes.txt").read_text() == "mine"


def test_a02_nothing_is_deleted_before_the_new_run_can_begin(undisturbed, tmp_path):
    run_dir = tmp_path / "run"
    shutil.copytree(undisturbed[0], run_dir, symlinks=True)
    with pytest.raises(ValueError, match=r"no\.h5"):
        train(tiny_args(run_dir, demos=(tmp_path / "no.h5",), overwrite=True))
    assert require_whole(run_dir / "checkpoints/last") == STEPS


def test_a02_runs_without_a_folder_get_one_each(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = train(tiny_args(None, steps=2, seed=3))
    time.sleep(1.1)  # the names have seconds
    second = train(tiny_args(None, steps=2, seed=3))
    assert first != second
    for checkpoint in (first, second):
        assert require_whole(checkpoint) == 2
        assert checkpoint.parts[:2] == ("runs", "diffusion_policy")
        assert checkpoint.parts[2].startswith("PegInsertion-tacff-seed3-20")


def test_a02_a_run_to_resume_must_be_named(tmp_path):
    with pytest.raises(InvalidArgumentError, match="--resume needs --run-dir"):
        train(tiny_args(None, resume=True))
    with pytest.raises(InvalidArgumentError, match="excludes --overwrite"):
        train(tiny_args(tmp_path / "run", resume=True, overwrite=True))


def test_a02_prune_spares_what_last_names(tmp_path):
    """A shorter run and a longer one in the same folder."""
    for step in (41000, 42000, 43000, 5000):
        save_checkpoint(tmp_path / f"{step:08d}", dict(step=step), dict(a=torch.ones(1)), dict(b=torch.ones(1)))
    make_last(tmp_path / "00005000")
    prune(tmp_path, 2, set())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["00005000", "00042000", "00043000", "last"]
    assert require_whole(tmp_path / "last") == 5000


def test_a02_a_checkpoint_is_never_replaced(tmp_path):
    tensors = dict(a=torch.ones(1))
    save_checkpoint(tmp_path / "00000001", dict(step=1), tensors, tensors)
    with pytest.raises(FileWriteError, match="00000001 cannot be written"):
        save_checkpoint(tmp_path / "00000001", dict(step=2), tensors, tensors)
    assert [path.name for path in tmp_path.iterdir()] == ["00000001"]
    assert require_whole(tmp_path / "00000001") == 1


def test_b06_a_second_training_in_a_folder_is_told_of_the_first(tmp_path):
    run_dir = tmp_path / "run"
    process = start(tiny_args(run_dir, steps=100_000))
    try:
        until = time.monotonic() + PATIENCE
        while not saved_checkpoints(run_dir / "checkpoints"):
            assert time.monotonic() < until
            time.sleep(0.01)
        for changes in ({}, dict(resume=True), dict(overwrite=True)):
            with pytest.raises(InUseError, match=f"process {process.pid} on"):
                train(tiny_args(run_dir, **changes))
        assert process.exitcode is None
    finally:
        process.kill()
        process.join()
    step = int(newest_checkpoint(run_dir / "checkpoints").name)
    assert require_whole(train(tiny_args(run_dir, steps=step + 2, resume=True))) == step + 2


# -------------------------------------------------------------------- other code


def test_a13_an_evaluation_does_not_import_from_the_current_folder(undisturbed, tmp_path):
    """In a process whose current folder has a torch.py, a json.py and a package of our name."""
    for name in ("torch.py", "json.py", "manifeel_ms3/__init__.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(f"import pathlib\npathlib.Path({str(tmp_path / 'executed')!r}).write_text({name!r})\n")
    checkpoint = os.path.relpath(undisturbed[0] / "checkpoints/00000040", tmp_path)
    kwargs = json.dumps(dict(render_backend="none", max_episode_steps=3))
    script = (
        f"import sys; sys.path.insert(0, {str(REPOSITORY)!r})\n"
        "from pathlib import Path\n"
        "from baselines.common.background_evaluation import BackgroundEvaluation\n"
        f"evaluation = BackgroundEvaluation(Path('evaluations'), 1, 1, {kwargs!r})\n"
        f"evaluation.submit(Path({checkpoint!r}))\n"
        "assert evaluation.finished(wait=True)\n"
    )
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/script.py").write_text(script)
    environment = os.environ | dict(PYTHONPATH=str(REPOSITORY))
    done = subprocess.run(
        [sys.executable, "elsewhere/script.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    said = [path.read_text() for path in tmp_path.glob("evaluations/*.log")]
    assert not (tmp_path / "executed").exists(), (tmp_path / "executed").read_text()
    assert done.returncode == 0, (done.stderr, said)
    assert (tmp_path / "evaluations/00000040.json").is_file()


# -------------------------------------------------------------------- damaged


@pytest.mark.parametrize(
    "harm",
    [
        lambda state: state.pop("random"),
        lambda state: state.update({"optimizer.x.exp_avg": torch.zeros(2)}),
        lambda state: state.update({"optimizer.99.exp_avg": torch.zeros(2)}),
        lambda state: state.update({"optimizer": torch.zeros(2), "optimizer.": torch.zeros(2)}),
        lambda state: state.update({"random": torch.zeros(3)}),
        lambda state: state.pop("model.bias"),
    ],
    ids=["no random state", "a parameter without a number", "an unknown parameter", "no parameter", "another type", "a weight"],
)
def test_a_damaged_state_of_training_is_refused_in_one_line(harm, tmp_path):
    model = torch.nn.Linear(2, 1)
    optimizer = torch.optim.AdamW(model.parameters())
    model(torch.ones(1, 2)).sum().backward()
    optimizer.step()
    state = pack(optimizer, model, [random_state()])
    unpack(state, optimizer, model, tmp_path, rank=0)
    harm(state)
    with pytest.raises(CheckpointError) as refused:
        unpack(state, optimizer, model, tmp_path, rank=0)
    assert str(tmp_path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_copy_of_a_run_that_followed_its_links_is_named_and_loses_nothing(tmp_path):
    for name in ("00000002", "last"):
        save_checkpoint(tmp_path / name, dict(step=2), {}, {})
    with pytest.raises(CheckpointError, match="last is a folder and not a link"):
        make_last(tmp_path / "00000002")
    shutil.rmtree(tmp_path / "last")
    make_last(tmp_path / "00000002")
    assert (tmp_path / "last").resolve() == tmp_path / "00000002"


def test_a_file_in_the_place_of_a_run_is_named_and_stays(tmp_path):
    (tmp_path / "run").write_text("notes")
    with pytest.raises(FileWriteError, match="run cannot be written"):
        train(tiny_args(tmp_path / "run"))
    assert (tmp_path / "run").read_text() == "notes"
