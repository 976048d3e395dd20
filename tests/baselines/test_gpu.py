"""Training, evaluation beside it, and studies on a CUDA GPU; without one, the CPU shows that the shorter test itself works."""

import json
import shutil

import pytest

from baselines.common.background_evaluation import BackgroundEvaluation
from baselines.studies import __main__ as study_command
from manifeel_ms3.evaluation.result import read_result, results_in
from tests.tasks_and_marks import ON_GPU, PEG
from tests.tiny_study import TINY
from tests.trust.tiny_checkpoint import save_tiny_checkpoint

BARE = json.dumps(dict(render_backend="none", max_episode_steps=6))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=ON_GPU)])
def test_a_checkpoint_is_evaluated_on_the_device_of_its_training(device, tmp_path):
    checkpoint = tmp_path / "checkpoints/00000001"
    shutil.copytree(save_tiny_checkpoint(tmp_path / "tiny"), checkpoint)
    config = json.loads((checkpoint / "config.json").read_text())
    (checkpoint / "config.json").write_text(json.dumps(config | dict(env_id=PEG, step=1)))
    evaluation = BackgroundEvaluation(tmp_path / "evaluations", episodes=2, workers=2, env_kwargs=BARE, device=device)
    evaluation.submit(checkpoint)
    (rates,) = evaluation.finished(wait=True)
    result = read_result(tmp_path / "evaluations/00000001.json")
    assert (rates["step"], rates["eval/episode_len"]) == (1, 6)
    assert result["inference"]["device"] == device
    assert [episode["error"] for episode in result["episodes"]] == [None, None]


@pytest.mark.parametrize("device", [pytest.param("cuda", marks=ON_GPU)])
def test_a_study_trains_and_evaluates_on_a_gpu(device, tmp_path):
    study = tmp_path / "tiny.yaml"
    shared = "{cpus: 1, gpus: 0.5}" if device == "cuda" else "{cpus: 1}"
    study.write_text(
        TINY.replace("train: {cpus: 1}, evaluate: {cpus: 1}", f"train: {shared}, evaluate: {shared}").replace(
            "train: {steps: 12", f"train: {{device: {device}, steps: 12"
        )
    )
    study_command.main(study_command.Args(study, tmp_path / "study"))
    results = list(results_in(tmp_path / "study").values())
    assert [result["config"]["step"] for result in results] == [6, 12]
    assert {result["config"]["device"] for result in results} == {device}
    assert {result["inference"]["device"] for result in results} == {device}
