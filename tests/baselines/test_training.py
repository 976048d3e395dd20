"""Every policy learns, saves, resumes, and refuses what is not its own."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from baselines.common import background_evaluation, training
from baselines.common.background_evaluation import BackgroundEvaluation
from baselines.common.checkpoint import read_tensors
from baselines.common.dataset import recorded_env_kwargs
from baselines.common.encoders import FIELD_ENCODERS, EncoderConfig, PretrainedEncoder
from baselines.common.recent_losses import TrainingError
from baselines.common.train_args import TrainArgs
from baselines.diffusion_policy import train as diffusion
from baselines.equivariant_diffusion_policy import train as equivariant
from baselines.flow_matching import train as flow
from baselines.references import MeanAction, Untrained
from baselines.registry import PolicySpec
from manifeel_ms3 import typed_modules
from manifeel_ms3.demonstrations import DemonstrationError, read_demonstrations
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError, checkpoint_config, samples_per_step
from tests.command_process import run_module
from tests.tasks_and_marks import PEG
from tests.trajectories import changed_copy
from tests.trust.running_evaluations import wait_for_episodes

POLICIES = {"diffusion": (diffusion, {}), "equivariant": (equivariant, {}), "flow": (flow, dict(noise_draws=8))}
POLICIES["consistency"] = (flow, dict(consistency=True))
QUICK = ["diffusion", "flow", "consistency", pytest.param("equivariant", marks=pytest.mark.slow)]
"""All policies; the equivariant one, whose convolutions are slow on a CPU, only in the slow run."""


@dataclasses.dataclass
class Run:
    """A policy's training on the recorded episodes."""

    spec: PolicySpec
    args: TrainArgs

    def again(self, **changes) -> Path:
        return self.spec.train(dataclasses.replace(self.args, **changes))


@pytest.fixture(scope="module", params=POLICIES)
def run(request, demos, tmp_path_factory):
    script, own = POLICIES[request.param]
    paper = script.PRESETS["paper"].args
    small = dict(
        encoder=EncoderConfig(force_field="small", tactile_features=64), down_dims=(32, 64), diffusion_step_embed_dim=32, **own
    )
    if script is not flow:
        small |= dict(diffusion_steps=20)
    args = dataclasses.replace(
        paper,
        demos=(demos,),
        obs_mode="tacff",
        cameras=(),
        policy=dataclasses.replace(paper.policy, **small),
        inference_steps=20,
        batch_size=32,
        steps=60,
        lr=1e-3,
        warmup_steps=5,
        save_freq=30,
        log_freq=15,
        device="cpu",
        precision="fp32",
        compile=False,
        run_dir=tmp_path_factory.mktemp("run"),
    )
    return Run(script.SPEC, args)


@pytest.fixture(scope="module")
def checkpoint(run):
    return run.again()


def log_of(folder: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def test_presets_hold_the_papers_hyperparameters():
    for script, lr in ((diffusion, 8e-5), (equivariant, 1e-4), (flow, 1e-4)):
        paper = script.PRESETS["paper"].args
        policy = paper.policy
        assert (policy.obs_horizon, policy.action_horizon, policy.pred_horizon) == (2, 8, 16)
        assert (paper.public_code_lr(), paper.betas) == (lr, (0.95, 0.999))
        assert (paper.weight_decay, paper.warmup_steps, paper.inference_steps) == (1e-6, 500, 100)
        assert (paper.batch_size, paper.image_size, paper.tactile_image_size) == (8, 256, 256)
        assert (policy.encoder.image, policy.encoder.force_field, policy.down_dims) == ("resnet18",) * 2 + ((512, 1024, 2048),)
    ddpm, ddim = diffusion.PRESETS["paper"].args.policy, equivariant.PRESETS["paper"].args.policy
    assert (ddpm.diffusion_steps, ddpm.sampler, ddpm.prediction, ddpm.encoder.crop) == (100, "ddpm", "epsilon", 0)
    assert (ddim.diffusion_steps, ddim.sampler, ddim.prediction, ddim.encoder.crop) == (100, "ddim", "sample", 230)
    assert (ddim.hidden, ddim.action_fields, ddim.encoder.tactile_features) == (128, 64, 128)


@pytest.mark.parametrize(
    ("mode", "encoder", "lr"), [("tacrgb", "t3", 1e-4), ("tacrgb", "resnet18", 8e-5), ("tacff", "t3", 8e-5)]
)
def test_diffusion_policy_has_the_public_codes_learning_rate_for_each_encoder(mode, encoder, lr):
    paper = diffusion.PRESETS["paper"].args
    policy = dataclasses.replace(paper.policy, encoder=EncoderConfig(tacrgb=encoder))
    assert dataclasses.replace(paper, obs_mode=f"rgb+{mode}", policy=policy).public_code_lr() == lr


def test_loss_falls(run, checkpoint):
    log = log_of(run.args.run_dir)
    assert [entry["step"] for entry in log] == [15, 30, 45, 60]
    assert {"losses/total_loss", "charts/learning_rate"} <= set(log[0])
    events = EventAccumulator(str(run.args.run_dir)).Reload()
    assert {"time/total_seconds", "time/iterations_per_second"} < set(events.Tags()["scalars"])
    consistency = getattr(run.args.policy, "consistency", False)  # its loss is a small disagreement, and noisy
    assert min(entry["losses/total_loss"] for entry in log) < (0.9 if consistency else 0.8) * log[0]["losses/total_loss"]


def test_checkpoints_hold_the_arguments_of_the_recorded_task(run, checkpoint):
    config = checkpoint_config(checkpoint)
    assert config["env_kwargs"] == recorded_env_kwargs(run.args.demos) != {}
    assert config["pose"] == ("rotation_6d" if run.spec is equivariant.SPEC else "quaternion")


def test_checkpoints_are_json_and_safetensors(run, checkpoint):
    assert {file.name for file in checkpoint.iterdir()} == {"config.json", "model.safetensors", "training.safetensors"}
    assert checkpoint_config(checkpoint)["step"] == 60
    older = run.args.run_dir / "checkpoints/00000030"
    assert {file.name for file in older.iterdir()} == {"config.json", "model.safetensors"}  # only the last can be resumed


def test_only_the_last_checkpoints_are_kept(run, tmp_path):
    run.again(run_dir=tmp_path, steps=20, batch_size=4, save_freq=4, keep=3)
    kept = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert kept == ["00000012", "00000016", "00000020", "last"]


@pytest.mark.parametrize("run", QUICK, indirect=True)
def test_resumed_training_equals_uninterrupted(run, checkpoint, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(training, "prune", stop)  # it is called after the first checkpoint
        with pytest.raises(KeyboardInterrupt):
            run.again(run_dir=tmp_path)
    assert checkpoint_config(tmp_path / "checkpoints/last")["step"] == 30
    resumed = run.again(run_dir=tmp_path, resume=True)
    assert checkpoint_config(resumed)["step"] == 60
    whole, second = read_tensors(checkpoint / "model.safetensors"), read_tensors(resumed / "model.safetensors")
    assert all(torch.equal(whole[name], second[name]) for name in whole)
    assert log_of(tmp_path) == log_of(run.args.run_dir)


class FromWeights(PretrainedEncoder):
    """A network of TacFF that is initialised from a file."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def load(self, weights):
        assert weights.is_file()

    def fit(self, images):
        """It needs no statistics."""

    def forward(self, field):
        return self.network(field)


@pytest.mark.parametrize("run", ["diffusion"], indirect=True)
def test_a_run_names_the_weights_that_it_began_with_by_their_content(run, tmp_path, monkeypatch):
    small = FIELD_ENCODERS["small"]
    monkeypatch.setitem(FIELD_ENCODERS, "small", lambda shape, features: FromWeights(small(shape, features)))
    names = []
    for content in ("one", "other"):
        folder = tmp_path / content
        folder.mkdir()
        weights = folder / "weights.safetensors"
        weights.write_text(content)
        again = dict(run_dir=folder / "run", save_freq=2)
        names.append(checkpoint_config(run.again(tacrgb_weights=weights, steps=2, **again))["tacrgb_weights"])
        weights.unlink()
        resumed = checkpoint_config(run.again(resume=True, steps=4, **again))
        assert (resumed["step"], resumed["tacrgb_weights"]) == (4, names[-1])
    assert names[0] != names[1]
    assert all(re.fullmatch("weights.safetensors [0-9a-f]{16}", name) for name in names)


@pytest.mark.parametrize("run", ["diffusion"], indirect=True)
def test_files_of_two_sensors_are_refused_by_the_name_of_what_differs(run, tmp_path):
    (demos,) = run.args.demos
    field = "obs/sensor_data/tactile_right/force_field"
    other = changed_copy(demos, tmp_path, field, lambda values: values[:, :8, :10], sensor="digit")
    with pytest.raises(DemonstrationError, match=r"sensor=None, .* with sensor='digit'"):
        run.again(demos=(demos, other), run_dir=tmp_path / "run")


@pytest.mark.parametrize("run", ["consistency"], indirect=True)
def test_a_policy_of_several_segments_is_not_evaluated_with_fewer_steps(run, checkpoint, tmp_path):
    copy = Path(shutil.copytree(checkpoint, tmp_path / "copy"))
    config = checkpoint_config(copy)
    config["policy"]["segments"] = 4
    (copy / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match="inference_steps=3 must be a whole number of at least 4"):
        run.spec.load(copy, inference_steps=3)
    assert run.spec.load(copy, inference_steps=4).inference_steps == 4
    assert run.spec.load(checkpoint, inference_steps=1).inference_steps == 1


@pytest.mark.parametrize("run", QUICK, indirect=True)
def test_the_seed_fixes_everything(run, tmp_path):
    losses = []
    for name, seed in (("first", 0), ("same", 0), ("other", 1)):
        run.again(run_dir=tmp_path / name, seed=seed, steps=30, batch_size=4)
        losses.append(log_of(tmp_path / name)[0]["losses/total_loss"])
    assert losses[0] == losses[1] != losses[2]


def test_resume_with_other_settings_names_them(run, checkpoint):
    with pytest.raises(CheckpointError, match=r"lr: 0\.001 there, 0.5 now"):
        run.again(resume=True, lr=0.5)
    policy = dataclasses.replace(run.args.policy, pred_horizon=run.args.policy.pred_horizon * 2)
    with pytest.raises(CheckpointError, match=r"\(policy\.pred_horizon: \d+ there, \d+ now\)"):
        run.again(resume=True, policy=policy)


def test_resume_without_a_checkpoint(run, tmp_path):
    with pytest.raises(CheckpointError, match=r"checkpoints has no checkpoint .*; leave out --resume"):
        run.again(resume=True, run_dir=tmp_path)


def test_a_loss_that_is_no_number_stops_the_run_and_names_its_batch(run, tmp_path):
    with pytest.raises(TrainingError, match=r"the loss of step \d+ is (nan|inf), on episode \d step \d+, .*--lr"):
        run.again(run_dir=tmp_path, lr=1e30, batch_size=4, save_freq=10, log_freq=10)
    weights = sorted((tmp_path / "checkpoints").glob("*/model.safetensors"))
    assert all(torch.isfinite(tensor).all() for path in weights for tensor in read_tensors(path).values())


@pytest.mark.parametrize("run", QUICK, indirect=True)
def test_bf16_agrees_with_fp32(run, tmp_path):
    for precision in ("bf16", "fp32"):
        run.again(run_dir=tmp_path / precision, precision=precision, steps=30, batch_size=8, log_freq=10)
    halves, wholes = ([entry["losses/total_loss"] for entry in log_of(tmp_path / name)] for name in ("bf16", "fp32"))
    assert halves == pytest.approx(wholes, rel=0.1, abs=1e-3)
    assert max(abs(half - whole) / whole for half, whole in zip(halves, wholes, strict=True)) > 1e-5  # a bf16 has 8 bits


def test_agent_acts_and_repeats_itself_after_reset(make_env, run, checkpoint):
    env = make_env(PEG, obs_mode="tacff", render_backend="none")
    agent = run.spec.load(checkpoint)
    obs, _ = env.reset(seed=0)
    first = [agent.act(obs) for _ in range(10)]
    agent.reset()
    second = [agent.act(obs) for _ in range(10)]
    assert all(a.shape == (6,) and (a == b).all() for a, b in zip(first, second, strict=True))
    few = run.spec.load(checkpoint, inference_steps=4)
    assert few.act(obs).shape == (6,)


@pytest.mark.parametrize("run", ["diffusion"], indirect=True)
def test_the_untrained_policy_has_the_weights_that_training_began_with(run, checkpoint, tmp_path):
    begun = run.again(run_dir=tmp_path, steps=1, lr=0.0)  # a step that changes nothing
    untrained, trained = Untrained(str(checkpoint)).policy.state_dict(), read_tensors(checkpoint / "model.safetensors")
    for name, first in read_tensors(begun / "model.safetensors").items():
        assert torch.equal(untrained[name], first), name
    assert not all(torch.equal(untrained[name], trained[name]) for name in trained)


def test_mean_action_is_that_of_all_steps(demos):
    episodes = read_demonstrations(demos, [])
    steps = sum(len(episode["actions"]) for episode in episodes)
    policy = MeanAction(str(demos))
    assert policy.act({}) == pytest.approx(sum(episode["actions"].sum(0) for episode in episodes) / steps, rel=1e-4)


def test_checkpoint_of_another_architecture_is_refused(run, checkpoint, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(checkpoint, other)
    config = checkpoint_config(other)
    config["policy"]["down_dims"] = [16, 32]
    (other / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match="another architecture"):
        run.spec.load(other)


def test_checkpoint_of_another_policy_is_refused(run, checkpoint, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(checkpoint, other)
    (other / "config.json").write_text(json.dumps(dict(kind="something:Else")))
    with pytest.raises(CheckpointError, match=f"does not describe the policy {run.spec.name!r}"):
        run.spec.load(other)


def test_truncated_weights_are_refused(run, checkpoint, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(checkpoint, other)
    (other / "model.safetensors").write_bytes((checkpoint / "model.safetensors").read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="cannot be read"):
        run.spec.load(other)


@pytest.fixture
def evaluation(tmp_path, checkpoint):
    for step in (1, 2):
        shutil.copytree(checkpoint, tmp_path / f"checkpoints/{step:08d}")
    kwargs = json.dumps(dict(render_backend="none", max_episode_steps=20))
    return BackgroundEvaluation(tmp_path / "evaluations", episodes=1, workers=1, env_kwargs=kwargs)


@pytest.mark.parametrize("run", ["diffusion"], indirect=True)
def test_checkpoints_are_evaluated_one_after_the_other(evaluation, tmp_path):
    folders = sorted((tmp_path / "checkpoints").iterdir())
    for folder in folders:
        evaluation.submit(folder)
    assert evaluation.finished() == []
    assert evaluation.in_use == set(folders)
    rates = evaluation.finished(wait=True)
    assert [rate["step"] for rate in rates] == [1, 2]
    assert {"eval/success_at_end", "eval/fail_once", "eval/return", "eval/episode_len"} <= set(rates[0])
    result = json.loads((tmp_path / "evaluations/00000001.json").read_text())
    assert rates[0]["eval/success_once"] == result["success_once"]["rate"]
    assert [episode["episode_len"] for episode in result["episodes"]] == [20]  # as the evaluation's arguments say
    assert evaluation.in_use == set()


@pytest.mark.parametrize("run", ["diffusion"], indirect=True)
def test_a_task_that_was_typed_with_its_module_is_evaluated_with_it(evaluation, tmp_path, monkeypatch):
    """A checkpoint names no module: nothing is imported because a file says so."""
    monkeypatch.setattr(typed_modules, "_imported", ["tests.task_of_mine", "tests.another"])
    monkeypatch.setattr(background_evaluation.subprocess, "Popen", lambda _command, **given: environments.append(given["env"]))
    environments, (checkpoint, _) = [], sorted((tmp_path / "checkpoints").iterdir())
    evaluation.submit(checkpoint)
    evaluation._start(checkpoint)
    assert environments[0]["MANIFEEL_TASKS"] == "tests.task_of_mine,tests.another"


@pytest.mark.parametrize("run", ["diffusion"], indirect=True)
def test_an_evaluation_that_was_stopped_continues_where_it_stopped(evaluation, tmp_path):
    """Except that it begins again if the checkpoint of this step is another one."""
    checkpoint, journal = tmp_path / "checkpoints/00000001", tmp_path / "evaluations/00000001.episodes.jsonl"
    kwargs = json.dumps(dict(render_backend="none", max_episode_steps=60))
    for change in (False, True):
        first, second = (BackgroundEvaluation(evaluation.folder, 4, 1, kwargs) for _ in range(2))
        first.submit(checkpoint)
        first.finished()
        wait_for_episodes(journal, 1)
        first.stop()
        kept = [json.loads(line) for line in journal.read_text().splitlines()[1:]]
        assert 0 < len(kept) < 4
        if change:
            config = json.loads((checkpoint / "config.json").read_text())
            (checkpoint / "config.json").write_text(json.dumps(config | dict(training_seconds=0.0)))
        second.submit(checkpoint)
        assert len(second.finished(wait=True)) == 1
        said = (evaluation.folder / "00000001.log").read_text()
        assert ("the evaluation goes on" in said, "the evaluation begins again" in said) == (not change, change)
        episodes = json.loads((evaluation.folder / "00000001.json").read_text())["episodes"]
        assert len(episodes) == 4
        assert all((episode in episodes) != change for episode in kept)  # an episode holds the time that it took


@pytest.mark.parametrize("run", ["diffusion"], indirect=True)
def test_an_evaluation_that_fails_does_not_stop_training(evaluation, tmp_path, caplog):
    (tmp_path / "checkpoints/00000001/config.json").write_text("broken")
    evaluation.submit(tmp_path / "checkpoints/00000001")
    assert evaluation.finished(wait=True) == []
    assert "00000001.log says why" in caplog.text
    assert "is not json" in (tmp_path / "evaluations/00000001.log").read_text()


@pytest.mark.parametrize("run", ["diffusion"], indirect=True)
def test_a_video_that_fails_does_not_hide_the_rates(evaluation, tmp_path, caplog):
    checkpoint, result = tmp_path / "checkpoints/00000001", tmp_path / "evaluations/00000001.json"
    evaluation._arguments += ["--videos", "0"]
    (tmp_path / "evaluations").mkdir()
    (tmp_path / "evaluations/videos").write_text("a file where the folder of the videos would be")
    evaluation.submit(checkpoint)
    (rates,) = evaluation.finished(wait=True)
    assert rates["eval/success_once"] == json.loads(result.read_text())["success_once"]["rate"]
    assert "a part of the evaluation of" in caplog.text


@pytest.mark.parametrize("run", ["diffusion"], indirect=True)
def test_two_processes_train_one_policy(run, tmp_path):
    arguments = ["cpu", "--demos", str(run.args.demos[0]), "--obs-mode", "tacff", "--steps", "60", "--batch-size", "16"]
    arguments += ["--save-freq", "60", "--log-freq", "20", "--run-dir", str(tmp_path)]
    arguments += ["--policy.down-dims", "32", "64", "--policy.diffusion-step-embed-dim", "32"]
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [*command, "baselines/diffusion_policy/train.py", *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "`manifeel eval --checkpoint " in done.stderr  # the end says what comes next
    losses = [entry["losses/total_loss"] for entry in log_of(tmp_path)]
    assert len(losses) == 3
    assert losses[-1] < 0.8 * losses[0]
    config = checkpoint_config(tmp_path / "checkpoints/last")
    assert (config["step"], samples_per_step(config)) == (60, 2 * 16)
    resumed = run_module("baselines.diffusion_policy.train", *arguments, "--resume", folder=tmp_path)
    assert "was trained with other settings (num_processes: 2 there, 1 now)" in resumed.stderr
