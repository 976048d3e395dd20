"""Publishing a study: which folder a result gets, and which results are never overwritten."""

import json
from pathlib import Path

import pytest
import torch

from baselines.common.checkpoint import read_tensors
from baselines.diffusion_policy import train as diffusion
from baselines.studies import half_precision
from baselines.studies.planning import Job
from baselines.studies.publish import publish
from manifeel_ms3.errors import FileExistsAlreadyError, InvalidArgumentError
from manifeel_ms3.evaluation.checkpoint_config import CONFIG, WEIGHTS
from manifeel_ms3.paths import CHECKPOINTS
from tests.analysis.made_up import write_run
from tests.trust.tiny_checkpoint import save_tiny_checkpoint


def finished(root: Path, title: str, **run) -> Job:
    """An evaluation in half precision that is done, with one made-up result and its checkpoint."""
    job = Job("evaluate", title, dict(half_precision=True, title=title))
    folder = job.folder(root)
    write_run(root / title, "rgb+tacrgb", 0.5, checkpoints=1, **run)
    (result,) = (root / title).rglob("*.json")
    checkpoint = folder / CHECKPOINTS / result.stem
    checkpoint.mkdir(parents=True)
    result.rename(folder / result.name)
    for name in (WEIGHTS, CONFIG):
        (checkpoint / name).write_text(title)
    (folder / "done.json").write_text(json.dumps(dict(settings=job.settings)))
    return job


def test_what_is_published_is_rounded_to_half_precision_without_the_state_of_training_and_local_paths(tmp_path):
    checkpoint = save_tiny_checkpoint(tmp_path / "checkpoint")
    config = json.loads((checkpoint / CONFIG).read_text()) | dict(demos=["/home/me/peg.h5"], run_dir="/home/me/run")
    (checkpoint / CONFIG).write_text(json.dumps(config))
    copy = half_precision.main(half_precision.Args(checkpoint, tmp_path / "copy"))
    assert {path.name for path in copy.iterdir()} == {WEIGHTS, CONFIG}
    whole, rounded = (read_tensors(folder / WEIGHTS) for folder in (checkpoint, copy))
    assert whole.keys() == rounded.keys()
    assert all(torch.equal(rounded[name], tensor.half()) for name, tensor in whole.items())
    assert {tensor.dtype for tensor in rounded.values()} == {torch.float16}
    assert json.loads((copy / CONFIG).read_text()) == config | dict(demos=["peg.h5"], run_dir="run")
    acts = diffusion.SPEC.load(copy).policy.state_dict()
    assert all(torch.equal(acts[name], tensor.half().float()) for name, tensor in whole.items())


def test_each_set_up_has_a_folder_of_its_own_in_a_submission(tmp_path):
    root, board = tmp_path / "study", tmp_path / "board"
    set_ups = {
        "PegInsertion/rgb+tacrgb": {},
        "PegInsertion/rgb+tacrgb-unit": dict(encoder="unit"),
        "PegInsertion/rgb+tacrgb-t3": dict(encoder="t3"),
        "PegInsertion/rgb+tacrgb-anytouch": dict(encoder="anytouch"),
        "PegInsertion/rgb+tacrgb-flow_matching": dict(policy="flow_matching"),
        "PegInsertion/rgb+tacrgb-front-left-right": dict(env_kwargs=dict(cameras=["front"], tactile_sensors=["left", "right"])),
        "PegInsertion/rgb+tacrgb-dim": dict(env_kwargs=dict(lighting="dim")),
        "PegInsertion/rgb+tacrgb-drift_0_1": dict(env_kwargs=dict(imperfections=dict(drift=0.1))),
        "PegInsertion/rgb+tacrgb-dead_taxels_0_1": dict(env_kwargs=dict(imperfections=dict(dead_taxels=0.1))),
    }
    jobs = [finished(root, f"run {k}", **run) for k, run in enumerate(set_ups.values())]
    for number_of_times in (1, 2):  # the second time, the same results are replaced
        assert publish(jobs, root, board, "tables", "us") == len(set_ups), number_of_times
        names = {path.parents[1].relative_to(board).as_posix() for path in board.glob("*/*/seed0/*.json")}
        assert names == set(set_ups)


def test_results_of_another_set_up_are_not_overwritten(tmp_path):
    root, board = tmp_path / "study", tmp_path / "board"
    first, other_seed = finished(root, "first"), finished(root, "other seed", seed=1)
    slower, again = finished(root, "slower", lr=1e-5), finished(root, "again")
    for both in ([first, slower], [first, again]):
        with pytest.raises(InvalidArgumentError, match=r"would both be published in .*PegInsertion/rgb\+tacrgb"):
            publish(both, root, board, "tables", "us")
    assert not board.exists()
    with pytest.raises(InvalidArgumentError, match="board is a new submission; give --authors"):
        publish([first], root, board)
    assert not board.exists()
    assert publish([first], root, board, authors="us") == 1
    assert json.loads((board / "submission.json").read_text())["name"] == "board"
    (published,) = board.glob("*/*/seed0/*.json")
    before = published.read_bytes()
    for seed in (0, 1):
        with pytest.raises(FileExistsAlreadyError, match=r"\(they differ in lr\); remove .*PegInsertion/rgb\+tacrgb, or"):
            publish([finished(root, f"slower, seed {seed}", lr=1e-5, seed=seed)], root, board, "tables", "us")
    assert publish([other_seed], root, board, "tables") == 2
    about = json.loads((board / "submission.json").read_text())
    assert (about["name"], about["authors"]) == ("tables", "us")
    assert published.read_bytes() == before


def test_a_video_of_an_earlier_checkpoint_does_not_stay_with_new_results(tmp_path):
    root, board = tmp_path / "study", tmp_path / "board"
    publish([first := finished(root, "first"), finished(root, "other", task="ObjectSearch")], root, board, "tables", "us")
    replaced, kept = (board / f"videos/{task}/rgb+tacrgb.mp4" for task in ("PegInsertion", "ObjectSearch"))
    for video in (replaced, kept):
        video.parent.mkdir(parents=True)
        video.write_bytes(b"video")
    publish([finished(root, "other seed", seed=1)], root, board)
    assert replaced.is_file()
    publish([first], root, board)
    assert (replaced.is_file(), kept.is_file()) == (False, True)


def test_a_submission_without_checkpoints_keeps_its_link(tmp_path):
    board = tmp_path / "board"
    board.mkdir()
    (board / "submission.json").write_text(json.dumps(dict(name="old", authors="we", link="https://example.org")))
    assert publish([finished(tmp_path, "first")], tmp_path, board, "new", "us") == 1
    about = json.loads((board / "submission.json").read_text())
    assert (about["name"], about["authors"], about["link"]) == ("new", "us", "https://example.org")
    assert len(about["checkpoints"]) == 1
