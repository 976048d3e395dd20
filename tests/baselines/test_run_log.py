"""What a run tells Weights & Biases, which writes it to disk, and tensorboard."""

import json
import struct
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from wandb.proto import wandb_internal_pb2

from baselines.common.run_log import GLOBAL_STEP, RunLog, wandb_run_of
from baselines.diffusion_policy.train import PRESETS
from manifeel_ms3.evaluation.video import encode_video
from tests.tasks_and_marks import PEG

ARGS = replace(
    PRESETS["cpu"].args, track=True, exp_name="peg-night", wandb_project_name="Pegs", obs_mode="rgb+tacff", env_id=PEG
)
TRAINED = {"step": 200, "losses/total_loss": 0.25, "time/total_seconds": 3.0}
EVALUATED = {"step": 100, "eval/success_once": 0.5}
"""An entry of training, and one of an evaluation that finished after it, of an earlier step."""

HEADER, BLOCK, CHUNK_HEADER = 7, 32768, 7
"""Bytes of the head of a .wandb file, of a block, and of the head of a chunk in it."""
WHOLE, LAST = 1, 4
"""Kinds of chunks that end a record."""
PATIENCE = 60  # s


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    """The folder of a run whose log was sent to Weights & Biases in its offline mode."""
    folder = tmp_path_factory.mktemp("run")
    video = folder / "video.mp4"
    video.write_bytes(encode_video([dict(wrist=np.full((64, 64, 3), 40 * k, np.uint8)) for k in range(5)]))
    args = replace(ARGS, eval_env_kwargs='{"fit": "tight"}', num_eval_envs=3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WANDB_MODE", "offline")
        patch.setenv("WANDB_SILENT", "true")
        with RunLog(folder, dict(seed=7, obs_mode="rgb+tacff"), 0, wandb_run_of(args, "diffusion_policy")) as log:
            log.write(TRAINED)
            log.write(EVALUATED, video)
    return folder


@pytest.fixture(scope="module")
def records(run_dir):
    """What Weights & Biases has written to disk and would send."""
    return _finished(run_dir)


def _finished(run_dir):
    """What Weights & Biases has written in the folder of a run, once that has ended."""
    (path,) = run_dir.glob("wandb/offline-run-*/run-*.wandb")
    deadline = time.monotonic() + PATIENCE
    found = parsed(path)
    while not any(record.HasField("exit") for record in found):  # the process that writes goes on for a moment after `finish`
        assert time.monotonic() < deadline
        time.sleep(0.1)
        found = parsed(path)
    return found


def parsed(path: Path) -> list[Any]:
    return [wandb_internal_pb2.Record.FromString(data) for data in leveldb_records(path.read_bytes()[HEADER:])]


def leveldb_records(data: bytes):
    """The records of a log of LevelDB's form: blocks of 32 KiB, of chunks with checksum, length, and kind."""
    place, record = 0, b""
    while place + CHUNK_HEADER <= len(data):
        left = BLOCK - (place + HEADER) % BLOCK
        if left < CHUNK_HEADER:  # the rest of a block that holds no other chunk
            place += left
            continue
        _, length, kind = struct.unpack_from("<IHB", data, place)
        record += data[place + CHUNK_HEADER : place + CHUNK_HEADER + length]
        place += CHUNK_HEADER + length
        if kind in (WHOLE, LAST):
            yield record
            record = b""


def values(entries) -> dict[str, Any]:
    return {"/".join(entry.nested_key) or entry.key: json.loads(entry.value_json) for entry in entries}


def test_a_run_is_named_grouped_and_tagged_and_says_what_it_is_evaluated_on(records):
    (run,) = (record.run for record in records if record.HasField("run"))
    assert (run.project, run.display_name, run.run_group) == ("Pegs", "peg-night", "diffusion_policy")
    assert list(run.tags) == ["diffusion_policy", "PegInsertion", "rgb+tacff"]
    config = values(run.config.update)
    assert config["eval_env_cfg"] == dict(env_id=PEG, env_kwargs=dict(fit="tight"), num_envs=3)
    assert (config["seed"], config["obs_mode"]) == (7, "rgb+tacff")


def test_entries_keep_the_step_that_they_are_about_even_an_earlier_one(records):
    trained, evaluated = (values(record.history.item) for record in records if record.HasField("history"))
    assert {name: trained[name] for name in TRAINED if name != "step"} == {k: v for k, v in TRAINED.items() if k != "step"}
    assert trained[GLOBAL_STEP] == TRAINED["step"]
    assert (evaluated[GLOBAL_STEP], evaluated["eval/success_once"]) == (EVALUATED["step"], EVALUATED["eval/success_once"])
    drawn_over = {
        record.metric.glob_name or record.metric.name: record.metric.step_metric
        for record in records
        if record.HasField("metric")
    }
    assert drawn_over["*"] == GLOBAL_STEP


def test_the_video_of_an_evaluation_goes_with_its_entry(records, run_dir):
    _, evaluated = (values(record.history.item) for record in records if record.HasField("history"))
    (copy,) = run_dir.glob(f"wandb/offline-run-*/files/{evaluated['eval/video/path']}")
    assert copy.read_bytes() == (run_dir / "video.mp4").read_bytes()


def test_tensorboard_has_the_success_at_the_step_of_the_checkpoint(run_dir):
    board = EventAccumulator(str(run_dir)).Reload()
    (event,) = board.Scalars("eval/success_once")
    assert (event.step, event.value) == (EVALUATED["step"], EVALUATED["eval/success_once"])
    assert [event.step for event in board.Scalars("losses/total_loss")] == [TRAINED["step"]]


def test_a_run_that_is_resumed_goes_on_under_its_id_and_a_new_one_has_another(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    ids = []
    for step in (0, 200, 0):
        with RunLog(tmp_path, {}, step, wandb_run_of(ARGS, "diffusion_policy")):
            pass
        newest = max(tmp_path.glob("wandb/offline-run-*/run-*.wandb"), key=lambda path: path.stat().st_mtime_ns)
        ids.append(newest.stem)
    assert ids[0] == ids[1] != ids[2]


def test_a_run_that_an_error_ends_is_shown_as_failed(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    with pytest.raises(ZeroDivisionError), RunLog(tmp_path, {}, 0, wandb_run_of(ARGS, "diffusion_policy")):
        raise ZeroDivisionError
    assert [record.exit.exit_code for record in _finished(tmp_path) if record.HasField("exit")] == [1]


def test_a_resumed_run_does_not_go_on_in_that_of_an_earlier_training(tmp_path, monkeypatch):
    """A training that is not tracked takes the place of a tracked one, and is tracked only after it was resumed."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    for step, track in ((0, True), (0, False), (200, True)):
        with RunLog(tmp_path, {}, step, wandb_run_of(replace(ARGS, track=track), "diffusion_policy")):
            pass
    assert len({path.stem for path in tmp_path.glob("wandb/offline-run-*/run-*.wandb")}) == 2


def test_nothing_is_sent_unless_it_is_asked_for():
    assert wandb_run_of(replace(ARGS, track=False), "diffusion_policy") is None
