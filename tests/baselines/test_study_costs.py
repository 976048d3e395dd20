"""The cost of a study's jobs, from trials."""

import json
import os
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from baselines.diffusion_policy.policy import DiffusionPolicy
from baselines.registry import all_policies
from baselines.studies import __main__ as study_command
from baselines.studies import cost, jobs
from baselines.studies.command_lines import training_args
from baselines.studies.planning import jobs_of
from baselines.studies.study import Resources, read_study
from baselines.studies.work import work_of
from manifeel_ms3.provenance import machine
from tests.tiny_study import TINY

REPOSITORY = Path(__file__).parents[2]


@pytest.mark.parametrize("obs_mode", ["rgb", "rgb+tacrgb", "tacff"])
@pytest.mark.parametrize("policy", sorted(all_policies()))
def test_every_policy_is_tried_out(policy, obs_mode):
    flags = ["cpu", "--obs-mode", obs_mode, "--image-size", "48", "--policy.encoder.crop", "0", "--batch-size", "2"]
    assert 0 < cost.gradient_step(policy, *flags) < 60
    assert 0 < cost.inference(policy, *flags, "--inference-steps", "2") < 60


def test_a_large_batch_is_estimated_from_a_small_one(monkeypatch):
    """A whole batch of the paper takes more memory than a laptop has; the optimizer's time does not grow with the batch."""
    monkeypatch.setattr(cost, "_seconds", lambda do, repeats: {"compute_gradients": 1.0, "update_weights": 0.25}[do.__name__])
    flags = ["cpu", "--obs-mode", "tacff", "--batch-size"]
    seconds = {batch: cost.gradient_step("diffusion_policy", *flags, str(batch)) for batch in (2, 1000)}
    assert seconds == {2: 1.25, 1000: 1000 / cost.TRIAL_BATCH + 0.25}


def test_a_quick_batch_is_measured_whole(monkeypatch):
    """A small network computes many samples in little more time than two."""
    batches = []

    def forward(self, obs, actions):
        batches.append(len(actions))
        return sum(weights.sum() for weights in self.parameters())

    monkeypatch.setattr(DiffusionPolicy, "forward", forward)
    cost.gradient_step("diffusion_policy", "cpu", "--obs-mode", "tacff", "--batch-size", "16")
    assert set(batches) == {cost.TRIAL_BATCH, 16}


@pytest.mark.parametrize("cpus", [1, 2])
def test_trials_have_as_many_threads_as_their_jobs(cpus, tmp_path):
    """Threads that outnumber the idle cores wait for each other, and a step takes 100 times as long."""
    train = next(job for job in jobs_of(read_study(REPOSITORY / "configs/modality.yaml")) if job.kind == "train")
    (trial,) = cost.trials_of(train, cpus)
    counts, before = [], torch.get_num_threads()
    threads = replace(trial, measure=lambda *_: counts.append(torch.get_num_threads()) or 1.0)
    assert threads.seconds(tmp_path) == 1.0
    assert (counts, torch.get_num_threads()) == ([cpus], before)


def test_trials_do_not_repeat_for_what_costs_the_same():
    jobs = jobs_of(read_study(REPOSITORY / "configs/modality.yaml"))
    steps = {trial.key for job in jobs if job.kind == "train" for trial in cost.trials_of(job)}
    assert len(steps) == 3  # one network for each observation mode, whatever the task, the camera and the seed


def test_trials_run_where_their_jobs_do(monkeypatch):
    study = read_study(REPOSITORY / "configs/modality.yaml")
    evaluate = next(job for job in jobs_of(study) if job.kind == "evaluate")
    given = study.resources["evaluate"].gpus
    assert given > 0
    for has_gpu, gpus, device, batch in ((True, given, "cuda", "16"), (True, 0, "cpu", "1"), (False, given, "cpu", "1")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda has_gpu=has_gpu: has_gpu)
        _, trial = cost.trials_of(evaluate, gpus=gpus)
        assert trial.arguments[-4:] == ("--device", device, "--batch-size", batch)
        (training,) = cost.trials_of(evaluate.needs[0], gpus=gpus)
        assert training.arguments[2:4] == ("--device", device)


def test_another_policy_sensing_or_device_is_other_work():
    """Else the hours of the paper's networks would be foretold from runs of small ones."""
    evaluations = [job for job in jobs_of(read_study(REPOSITORY / "configs/modality.yaml")) if job.kind == "evaluate"]
    of_a_task = [job for job in evaluations if job.settings["env_id"] == evaluations[0].settings["env_id"]]
    works = [work_of(job, 0) for job in of_a_task]
    assert len(set(works)) == 4  # three sensings, of which TacFF has two units
    assert len(works) > 4  # several training seeds of each
    (train,) = of_a_task[0].needs
    other = replace(of_a_task[0], needs=(replace(train, settings=train.settings | dict(preset="cpu")),))
    assert work_of(other, 0) != work_of(of_a_task[0], 0) != work_of(of_a_task[0], 1)


def test_one_policy_answers_all_workers(monkeypatch, tmp_path):
    """More workers simulate faster, but do not make the policy's process faster."""
    evaluate = next(job for job in jobs_of(read_study(REPOSITORY / "configs/modality.yaml")) if job.kind == "evaluate")
    monkeypatch.setattr(cost.Trial, "seconds", lambda trial, root: 8.0 if trial.measure is cost.inference else 1.0)
    chunk = training_args(evaluate.needs[0]).policy.action_horizon
    assert chunk == 8
    one, two, sixteen = (cost.estimate(evaluate, tmp_path, workers).seconds for workers in (1, 2, 16))
    assert one == pytest.approx(2 * two)  # a step of the simulation takes as long as an answer's share in it
    assert two == sixteen  # the policy is never idle
    monkeypatch.setattr(cost, "_device", lambda gpus: "cuda")
    assert cost.estimate(evaluate, tmp_path, 16, gpus=1).seconds == pytest.approx(one / 16)  # answers come in batches of 16


@pytest.mark.parametrize("num_seeds", [10, 40])
def test_a_table_of_progress_reads_each_job_once(num_seeds, tmp_path, monkeypatch):
    """It is made every few seconds by the process that also hands out the jobs."""
    path = tmp_path / "study.yaml"
    path.write_text(TINY.replace("seeds: [0]", f"seeds: {list(range(num_seeds))}"))
    study = read_study(path)
    planned = jobs_of(study)
    record, trained = planned[0], [job for job in planned if job.kind == "train"]
    for job, seconds in [(record, 1.0), *((job, 36.0 + 3.6 * k) for k, job in enumerate(trained[:5]))]:
        folder = job.folder(tmp_path)
        folder.mkdir(parents=True)
        done = dict(work=work_of(job, 0), seconds=seconds, units=12, parallel=1, machine=machine())
        (folder / jobs.DONE).write_text(json.dumps(done))
    calls = Counter()
    for module, name in ((jobs, "read_status"), (cost, "work_of"), (cost, "_units")):
        original = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *given, of=original, name=name: calls.update([name]) or of(*given))
    columns = [list(column.cells) for column in study_command.progress(study, planned, tmp_path).renderables[0].columns]
    assert columns[:5] == [
        ["record", "train", "evaluate"],
        ["1", "5", "0"],
        ["0", "0", "0"],
        ["0", "0", "0"],
        ["1", str(num_seeds), str(num_seeds)],
    ]
    assert columns[5] == ["0.00", f"{0.012 * (num_seeds - 5):.2f}", "?"]  # the median of those that were done: 43.2 s
    assert calls["read_status"] <= 2 * len(planned)
    assert calls["work_of"] <= len(planned) + 6
    assert calls["_units"] <= len(planned)


def test_a_job_that_was_interrupted_costs_what_all_its_attempts_took(tmp_path, monkeypatch):
    """The last attempt of a long job may do a small part of its work."""
    path = tmp_path / "study.yaml"
    path.write_text(TINY)
    record = jobs_of(read_study(path))[0]
    folder, now = record.folder(tmp_path), time.time()

    def die(*_):
        raise KeyboardInterrupt

    monkeypatch.setitem(jobs.WORK, "record", die)
    for attempt, (started, written) in enumerate(((900, 300), (200, 160)), start=1):  # s ago
        with pytest.raises(KeyboardInterrupt):
            jobs.perform(record, tmp_path, Resources())
        assert jobs.read_status(folder / jobs.STARTED)["attempts"] == attempt
        (folder / f"{attempt}.h5").write_text("")
        for name, seconds in ((jobs.STARTED, started), (f"{attempt}.h5", written)):
            os.utime(folder / name, (now - seconds, now - seconds))
    monkeypatch.setitem(jobs.WORK, "record", lambda *_: 4)
    jobs.perform(record, tmp_path, Resources())
    assert jobs.read_status(folder / jobs.DONE)["seconds"] == pytest.approx(600 + 40, abs=10)
    assert cost.estimate(record, tmp_path, 1).seconds == pytest.approx(640 / 4, abs=3)
