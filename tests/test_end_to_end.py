"""The steps of `make demo` in small: record, train, evaluate, report, through the command lines' own entry points."""

import json
from pathlib import Path

import pytest

from baselines.common.checkpoint import make_last, save_checkpoint
from baselines.common.encoders import EncoderConfig
from baselines.diffusion_policy import train
from baselines.diffusion_policy.policy import DiffusionConfig
from manifeel_ms3.demonstrations import record
from manifeel_ms3.evaluation import evaluate, report
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError
from manifeel_ms3.evaluation.result import ResultError
from manifeel_ms3.tasks.visuotactile_env import VisuotactileEnv
from tests.tasks_and_marks import PEG, needs_renderer

TASK_ARGS = json.dumps(dict(fit="paper", randomization=dict(socket_xy=0.01), max_episode_steps=75))


@needs_renderer
def test_from_demonstrations_to_a_report(tmp_path: Path):
    demos = record.main(
        record.Args(PEG, 2, 2, out=tmp_path / "trajectory.h5", obs_mode="rgb+tacff", cameras=("wrist",), env_kwargs=TASK_ARGS)
    )
    small = DiffusionConfig(encoder=EncoderConfig("small_cnn", "small"), down_dims=(32, 64), diffusion_step_embed_dim=32)
    args = train.Args(
        (demos,),
        policy=small,
        image_size=48,
        inference_steps=4,
        batch_size=16,
        steps=10,
        device="cpu",
        run_dir=tmp_path,
    )
    checkpoint = train.main(args)
    result_file = evaluate.main(evaluate.Args(checkpoint, episodes=1, env_kwargs=TASK_ARGS))
    result = json.loads(result_file.read_text())
    assert result["env_id"] == PEG
    assert len(result["episodes"]) == 1
    assert result["success_once"]["low"] <= result["success_once"]["rate"] <= result["success_once"]["high"]
    assert set(result["versions"]) >= {"mani-skill", "sapien", "torch"}
    again = json.loads(
        evaluate.main(evaluate.Args(checkpoint, out=tmp_path / "again.json", episodes=1, env_kwargs=TASK_ARGS)).read_text()
    )
    for name in ("success_once", "episode_len", "peak_contact_force"):
        assert again["episodes"][0][name] == result["episodes"][0][name]
    page = report.main(report.Args(tmp_path)).read_text()
    for needed in ("data:video/mp4;base64,", "data:image/png;base64,", "Wilson", "socket_xy", "TacFF", "plotly"):
        assert needed in page
    for of_the_forces in ("gentle success", "contact force allowed"):
        assert of_the_forces in page
    assert 'src="http' not in page


def test_the_reports_randomization_needs_no_simulation(monkeypatch):
    monkeypatch.setattr(VisuotactileEnv, "__init__", lambda *_args, **_kwargs: pytest.fail("a simulation is built"))
    ranges = report.randomization_of(dict(env_id=PEG, env_kwargs=dict(randomization=dict(start_z=0.0))))
    assert ranges["start_z"] == (0.0, 0.05)
    plain = report.randomization_of(dict(env_id=PEG, env_kwargs={}))
    assert all(used == default for used, default in plain.values())
    assert set(plain) == set(ranges)


def test_report_without_an_evaluation(tmp_path):
    with pytest.raises(ResultError, match="cannot be read as a result"):
        report.main(report.Args(tmp_path))


def test_a_report_shows_the_checkpoint_that_was_evaluated_and_not_a_later_one(tmp_path):
    def trained(step: int) -> Path:
        checkpoint = tmp_path / f"checkpoints/{step:08d}"
        save_checkpoint(checkpoint, dict(step=step), {}, {})
        make_last(checkpoint)
        return checkpoint

    first, second, evaluation = trained(5), trained(10), tmp_path / "evaluation.json"
    found = {step: report.evaluated_checkpoint(evaluation, dict(config=dict(step=step))) for step in (5, 10)}
    assert {step: checkpoint.resolve() for step, checkpoint in found.items()} == {5: first, 10: second}
    with pytest.raises(CheckpointError, match="is of step 4, whose checkpoint is not in"):
        report.evaluated_checkpoint(evaluation, dict(config=dict(step=4)))
    of_another = dict(config=dict(step=10, inference_steps=4, seed=1))
    found = report.evaluated_checkpoint(evaluation, of_another)
    assert found.resolve() == second  # the number of steps is the evaluation's
    (second / "config.json").write_text(json.dumps(dict(step=10, inference_steps=8, seed=0)))
    with pytest.raises(CheckpointError, match="is of another training than"):
        report.evaluated_checkpoint(evaluation, of_another)
