"""The pieces of the training loop, each alone."""

import dataclasses
import json
import math
import sys
from contextlib import suppress
from itertools import pairwise

import psutil
import pytest
import torch
from diffusers.optimization import get_cosine_schedule_with_warmup

from baselines.common.checkpoint import TRAINING_STATE, WEIGHTS, prune, read_tensors, saved_checkpoints
from baselines.common.dataset import SampleOrder, read_episodes
from baselines.common.encoders import EncoderConfig, field_encoder, register_tacrgb_encoder
from baselines.common.observation import TAXEL_SHAPE, observation_spec
from baselines.common.processes import Processes
from baselines.common.recent_losses import RecentLosses, TrainingError
from baselines.common.train_args import FREE_ON_RESUME, PAPER_EPOCHS, TrainArgs, check_evaluation, check_run, planned_steps
from baselines.common.training import Trainer, fast_forward, with_taxel_shape
from baselines.diffusion_policy import train as diffusion
from baselines.diffusion_policy.policy import DiffusionConfig
from baselines.flow_matching.policy import FlowConfig
from baselines.registry import PolicySpec, require_distinct
from baselines.studies.planning import OF_THE_MACHINE
from manifeel_ms3.analysis.condition import NO_SETTINGS, OF_MODALITIES, settings_of
from manifeel_ms3.demonstrations import read_demonstrations
from manifeel_ms3.errors import InvalidArgumentError, MachineError, MissingExtraError, PluginError, WorkFailedError
from manifeel_ms3.evaluation.checkpoint_config import CONFIG, IMPLIED
from manifeel_ms3.evaluation.result import PATHS
from tests.sample import observed_sample, states_sample
from tests.tasks_and_marks import PEG
from tests.trajectories import changed_copy

from .two_processes import end_before_the_evaluation, in_two_processes, resume_and_compare

CPU = torch.device("cpu")
SPEC = observation_spec("tacff", (), ("right",), 64)


@pytest.mark.parametrize(("num_demos", "num_samples", "batch_size", "steps"), [(50, 4200, 8, 525_000), (2, 9, 4, 75_000)])
def test_without_a_length_training_has_the_papers_epochs_over_all_demonstrations(num_demos, num_samples, batch_size, steps):
    assert planned_steps(TrainArgs(demos=()), num_demos, num_samples, batch_size) == steps
    epochs = steps / -(-num_samples // batch_size)
    assert epochs * num_demos == PAPER_EPOCHS


@pytest.mark.parametrize(("length", "steps"), [(dict(), 30 * 263), (dict(min_steps=9000), 9000), (dict(steps=7), 7)])
def test_a_length_in_epochs_counts_unless_that_is_fewer_steps_than_wanted_or_steps_are_given(length, steps):
    args = TrainArgs(demos=(), epochs=30, **length)
    assert planned_steps(args, 50, 4200, 16) == steps


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (dict(num_demos=-1), "--num-demos -1 must be at least 1"),
        (dict(batch_size=0), "--batch-size 0 must be at least 1"),
        (dict(steps=0), "--total-iters 0 must be at least 1"),  # not the paper's number of steps
        (dict(epochs=0), "--epochs 0 must be at least 1"),
        (dict(min_steps=0), "--min-iters 0 must be at least 1"),
        (dict(save_freq=0, eval_freq=5), "--save-freq 0 must be at least 1"),
        (dict(keep=-2), "--keep -2 must be at least 1"),
        (dict(eval_freq=0), "--eval-freq 0 must be at least 1"),
        (dict(num_eval_envs=0), "--num-eval-envs 0 must be at least 1"),
        (dict(num_eval_episodes=-1), "--num-eval-episodes -1 must be at least 1"),
        (dict(inference_steps=0), "--inference-steps 0 must be at least 1"),  # else the first evaluation fails, hours later
        (dict(log_freq=0), "--log-freq 0 must be at least 1"),
        (dict(seed=-1), "--seed -1 must be at least 0"),
        (dict(lr=-0.1), "--lr -0.1 must be a number of at least 0"),
        (dict(lr=float("nan")), "--lr nan must be a number of at least 0"),
        (dict(weight_decay=-1e-6), "--weight-decay -1e-06 must be a number of at least 0"),
        (dict(ema_power=float("inf")), "--ema-power inf must be a number of at least 0"),
        (dict(betas=(0.9, 1.0)), "--betas 1.0: a decay rate must be at least 0 and below 1"),
        (dict(ema_max_decay=float("nan")), "--ema-max-decay nan: a decay rate must be at least 0 and below 1"),
        (
            dict(policy=FlowConfig(consistency=True, segments=2), inference_steps=1),  # would stop short of the actions
            "--inference-steps 1: this policy needs at least 2 to generate",
        ),
        (
            dict(policy=DiffusionConfig(diffusion_steps=50), inference_steps=51),  # would be cut to 50, which no result says
            "--inference-steps 51: this policy needs at least 2 and at most 50 to generate",
        ),
        (dict(env_id=PEG), "no demonstrations are given; give --demo-path"),
    ],
)
def test_numbers_that_no_run_can_meet_are_refused(settings, said):
    with pytest.raises(InvalidArgumentError, match=said):
        check_run(TrainArgs((), **settings))


@pytest.mark.parametrize(
    ("settings", "error", "said"),
    [
        (dict(eval_env_kwargs="{fit"), InvalidArgumentError, "--eval-env-kwargs '{fit' is not json"),
        (dict(eval_env_kwargs="[1]"), InvalidArgumentError, r"--eval-env-kwargs '\[1\]' is not a json object"),
        (dict(eval_env_kwargs='{"obs_mode": "rgb"}'), InvalidArgumentError, "have obs_mode 'rgb', but the policy observes"),
        (dict(eval_env_kwargs='{"fits": "tight"}'), InvalidArgumentError, r"has no arguments \['fits'\]; choose from"),
        (dict(eval_env_kwargs='{"fit": "tight"}'), InvalidArgumentError, "--eval-env-kwargs without --num-eval-episodes"),
        (dict(eval_freq=7000, capture_video=True), InvalidArgumentError, "--eval-freq, --capture-video without --num-eval-ep"),
        (dict(device="gpu"), InvalidArgumentError, "--device 'gpu' is no device of torch"),
        (dict(device="cuda:99"), MachineError, "--device cuda:99 is not there"),
    ],
)
def test_what_only_a_later_evaluation_or_step_would_meet_is_refused_at_the_start(settings, error, said, tmp_path):
    args = dataclasses.replace(diffusion.PRESETS["cpu"].args, demos=(states_sample(PEG),), run_dir=tmp_path / "run")
    with pytest.raises(error, match=said):
        diffusion.SPEC.train(dataclasses.replace(args, **settings))
    assert not (tmp_path / "run/log.jsonl").exists()


def test_videos_that_no_evaluation_could_make_are_refused_at_the_start(monkeypatch):
    monkeypatch.delitem(sys.modules, "manifeel_ms3.evaluation.video", raising=False)
    monkeypatch.setitem(sys.modules, "imageio", None)
    args = TrainArgs((), env_id=PEG, num_eval_episodes=1)
    check_evaluation(args)
    with pytest.raises(MissingExtraError, match="imageio is not installed: pip install"):
        check_evaluation(dataclasses.replace(args, capture_video=True))


def test_the_task_is_that_of_the_demonstrations_unless_another_is_named():
    gear = "ManiFeel-GearAssembly-v1"
    args = TrainArgs((states_sample(gear),)).with_task_defaults()
    assert (args.env_id, args.cameras) == (gear, ("wrist",))
    assert TrainArgs((states_sample(gear),), env_id="PegInsertion").with_task_defaults().env_id == PEG


def test_actions_that_were_recorded_in_double_precision_are_read_as_networks_take_them(tmp_path):
    recorded = observed_sample(PEG)
    precise = changed_copy(recorded, tmp_path, "actions", lambda actions: actions.astype("float64"))
    *_, expected = read_episodes([recorded], PEG, SPEC, None)
    *_, found = read_episodes([precise], PEG, SPEC, None)
    assert found["actions"].dtype == "float32"
    assert (found["actions"] == expected["actions"]).all()


def test_each_epoch_holds_every_sample_once():
    order = SampleOrder(12, seed=0)
    first, second = (torch.cat([order.take(4) for _ in range(3)]) for _ in range(2))
    assert sorted(first.tolist()) == sorted(second.tolist()) == list(range(12))
    assert first.tolist() != second.tolist()


def test_a_batch_may_be_larger_than_the_data():
    assert sorted(SampleOrder(3, seed=0).take(6).tolist()) == [0, 0, 1, 1, 2, 2]


def test_an_order_continues_from_its_state():
    order = SampleOrder(7, seed=0)
    order.take(4)
    state = {name: tensor.clone() for name, tensor in order.state_dict().items()}
    expected = [order.take(4).tolist() for _ in range(5)]
    other = SampleOrder(7, seed=1)
    other.load_state_dict(state)
    assert [other.take(4).tolist() for _ in range(5)] == expected


def schedule_of(steps: int) -> torch.optim.lr_scheduler.LambdaLR:
    optimizer = torch.optim.AdamW([torch.nn.Parameter(torch.zeros(1))], 1e-3)
    return get_cosine_schedule_with_warmup(optimizer, 10, steps)


def test_a_resumed_schedule_has_the_learning_rates_of_an_uninterrupted_one():
    whole, resumed = schedule_of(40), schedule_of(40)
    rates = []
    for _ in range(30):
        whole.optimizer.step()
        whole.step()
        rates.append(whole.optimizer.param_groups[0]["lr"])
    fast_forward(resumed, 12)
    assert resumed.optimizer.param_groups[0]["lr"] == rates[11]
    for rate in rates[12:]:
        resumed.optimizer.step()
        resumed.step()
        assert resumed.optimizer.param_groups[0]["lr"] == rate


def test_a_schedule_rises_and_then_falls_to_zero():
    schedule = schedule_of(40)
    rates = []
    for step in range(41):
        fast_forward(schedule, step)
        rates.append(schedule.optimizer.param_groups[0]["lr"])
    assert rates[0] == 0
    assert rates[10] == 1e-3
    assert rates[40] == pytest.approx(0, abs=1e-12)
    assert all(a < b for a, b in pairwise(rates[:11]))
    assert all(a > b for a, b in pairwise(rates[10:]))


def test_recent_losses_give_their_mean_and_start_again():
    losses = RecentLosses(3, CPU)
    for value in (1.0, 2.0, 6.0):
        assert not losses.full
        losses.add(torch.tensor(value), torch.tensor([0]))
    assert losses.full
    assert losses.take_mean(3, str) == 3.0
    losses.add(torch.tensor(5.0), torch.tensor([0]))
    assert losses.take_mean(4, str) == 5.0


def test_a_loss_that_is_no_number_names_the_first_step_and_its_samples():
    losses = RecentLosses(4, CPU)
    for value, sample in ((1.0, 10), (float("nan"), 20), (float("inf"), 30)):
        losses.add(torch.tensor(value), torch.tensor([sample]))
    with pytest.raises(TrainingError, match=r"the loss of step 42 is nan, on samples \[20\]") as raised:
        losses.take_mean(43, lambda batch: f"samples {batch.tolist()}")
    assert isinstance(raised.value, WorkFailedError)


def test_prune_keeps_the_newest_and_those_in_use(tmp_path):
    folders = [tmp_path / f"{step:08d}" for step in range(1, 6)]
    for folder in folders:
        folder.mkdir()
        (folder / TRAINING_STATE).touch()
    prune(tmp_path, 2, {folders[0]})
    assert sorted(tmp_path.iterdir()) == [folders[0], *folders[3:]]
    assert [folder for folder in folders if (folder / TRAINING_STATE).exists()] == folders[-1:]


@pytest.fixture
def trainer_args(demos, tmp_path):
    paper = diffusion.PRESETS["paper"].args
    policy = dataclasses.replace(
        paper.policy, encoder=EncoderConfig(force_field="small"), down_dims=(16, 32), diffusion_step_embed_dim=16
    )
    run = dict(demos=(demos,), obs_mode="tacff", cameras=(), policy=policy, run_dir=tmp_path, batch_size=4, steps=6, log_freq=4)
    return dataclasses.replace(paper, **run, device="cpu", precision="fp32", compile=False)


def test_lists_of_settings_name_settings_that_there_are(trainer_args):
    """A setting that is renamed must be renamed in these lists, too."""
    checkpoint = Trainer(trainer_args, diffusion.DiffusionPolicy, Processes("cpu")).save()
    config = json.loads((checkpoint / CONFIG).read_text())
    known = config.keys() | {field.name for field in dataclasses.fields(TrainArgs)}
    assert known >= {*FREE_ON_RESUME, *NO_SETTINGS, *OF_THE_MACHINE, *PATHS}
    for name in IMPLIED:  # at these values, settings are left out
        *places, last = name.split(".")
        entry = config
        for place in places:
            entry = entry[place]
        assert last in entry
        entry[last] = "another"
    assert {name for name, _ in settings_of(config, "rgb+tacrgb+tacff")} >= set(OF_MODALITIES)


def test_a_step_changes_the_weights_and_a_trainer_resumes_where_another_saved(trainer_args):
    first = Trainer(trainer_args, diffusion.DiffusionPolicy, Processes("cpu"))
    before = [parameter.clone() for parameter in first.policy.parameters()]
    for _ in range(3):
        first.take_step()
    assert any(not torch.equal(old, new) for old, new in zip(before, first.policy.parameters(), strict=True))
    config_file = first.save() / "config.json"
    assert config_file.parent.name == "00000003"
    config = json.loads(config_file.read_text())
    assert config.pop("num_processes") == 1
    assert config["policy"].pop("action_form") == "delta"
    config["training_seconds"] = 1000.0
    config_file.write_text(json.dumps(config))  # as versions wrote it that did not have these settings
    second = Trainer(dataclasses.replace(trainer_args, resume=True), diffusion.DiffusionPolicy, Processes("cpu"))
    assert second.step == 3
    own, other = first.policy.state_dict(), second.policy.state_dict()
    assert all(torch.equal(own[name], other[name]) for name in own)
    pairs = zip(first.ema.shadow_params, second.ema.shadow_params, strict=True)
    assert all(torch.equal(own, other) for own, other in pairs)
    assert second.optimizer.param_groups[0]["lr"] == first.optimizer.param_groups[0]["lr"]
    assert torch.equal(second.order.take(4), first.order.take(4))
    second.step += 1
    assert 1000 < json.loads((second.save() / "config.json").read_text())["training_seconds"] < 2000


class TiedPolicy(diffusion.DiffusionPolicy):
    """A policy that uses one weight under two names."""

    def __init__(self, config, spec, action_dim):
        super().__init__(config, spec, action_dim)
        self.action_network.register_module("again", self.encoder)


def test_a_weight_with_two_names_is_saved_under_both(trainer_args):
    first = Trainer(trainer_args, TiedPolicy, Processes("cpu"))
    first.take_step()
    saved = read_tensors(first.save() / WEIGHTS)
    names = [name for name in saved if name.startswith("encoder.")]
    assert names
    assert all(torch.equal(saved[name], saved[f"action_network.again.{name.removeprefix('encoder.')}"]) for name in names)
    second = Trainer(dataclasses.replace(trainer_args, resume=True), TiedPolicy, Processes("cpu"))
    own, other = first.policy.state_dict(), second.policy.state_dict()
    assert all(torch.equal(own[name], other[name]) for name in own)
    for trainer in (first, second):
        averaged = dict(zip(trainer.policy.parameters(), trainer.ema.shadow_params, strict=True))
        assert all(torch.equal(saved[name], averaged[weight]) for name, weight in trainer.policy.named_parameters())


def test_a_run_has_the_settings_that_it_was_given(trainer_args, demos):
    """Its learning rates, its averaged weights, its optimiser, and the demonstrations that it learns from."""
    few = dict(
        num_demos=1, log_freq=9, warmup_steps=2, lr=0.01, betas=(0.8, 0.9), weight_decay=0.03, ema_power=0.5, ema_max_decay=0.4
    )
    trainer = Trainer(dataclasses.replace(trainer_args, **few), diffusion.DiffusionPolicy, Processes("cpu"))
    (group,) = trainer.optimizer.param_groups
    assert (group["betas"], group["weight_decay"]) == ((0.8, 0.9), 0.03)
    rates, averaged = [], [parameter.clone() for parameter in trainer.policy.parameters()]
    for step in range(6):
        rates.append(group["lr"])
        trainer.take_step()
        decay = min(0.4, 1 - (1 + step) ** -0.5)
        for old, new in zip(averaged, trainer.policy.parameters(), strict=True):
            old.lerp_(new.detach(), 1 - decay)
        torch.testing.assert_close(trainer.ema.shadow_params, averaged)
    assert rates == pytest.approx([0.0, 0.005, *(0.005 * (1 + math.cos(math.pi * step / 4)) for step in range(4))])
    first, _ = read_demonstrations(demos, SPEC.keys)
    assert (trainer.config["num_demos"], trainer.config["num_samples"]) == (1, len(first["actions"]) - 7)
    fitted = {key: trainer.policy.obs_normalizer(key) for key in SPEC.force_fields} | dict(
        actions=trainer.policy.action_normalizer
    )
    for key, normalizer in fitted.items():
        values = torch.as_tensor(first[key][: len(first["actions"])])
        assert torch.equal(normalizer.low, values.amin(0)), key
        assert torch.equal(normalizer.high, values.amax(0)), key


@pytest.mark.parametrize(
    ("given", "evaluated", "saved"),
    [
        (dict(), [2, 4, 6, 7], [2, 4, 6, 7]),
        (dict(eval_freq=4), [4, 7], [2, 4, 6, 7]),
        (dict(eval_freq=3), [3, 6, 7], [2, 3, 4, 6, 7]),  # no multiple of save_freq
    ],
)
def test_checkpoints_are_evaluated_as_often_as_asked_and_at_the_end(trainer_args, monkeypatch, given, evaluated, saved):
    args = dataclasses.replace(trainer_args, **dict(steps=7, save_freq=2, num_eval_episodes=1) | given)
    trainer, submitted = Trainer(args, diffusion.DiffusionPolicy, Processes("cpu")), []
    monkeypatch.setattr(trainer.evaluation, "submit", submitted.append)
    trainer.run()
    assert [int(checkpoint.name) for checkpoint in submitted] == evaluated
    assert [int(checkpoint.name) for checkpoint in saved_checkpoints(trainer.checkpoints)] == saved


def test_two_processes_resume_bit_for_bit(trainer_args):
    in_two_processes(resume_and_compare, trainer_args)


def test_only_the_first_process_waits_for_the_evaluations(trainer_args):
    env_kwargs = '{"render_backend": "none", "max_episode_steps": 20}'
    in_two_processes(
        end_before_the_evaluation, dataclasses.replace(trainer_args, num_eval_episodes=1, eval_env_kwargs=env_kwargs)
    )


def test_force_field_encoders_take_the_taxels_of_the_data():
    (key,) = SPEC.force_fields
    spec = with_taxel_shape(SPEC, {key: torch.zeros(5, 7, 9, 3).numpy()})
    assert (SPEC.taxel_shape, spec.taxel_shape) == (TAXEL_SHAPE, (7, 9))
    for name, features in (("small", 24), ("resnet18", 24), ("resnet18", 512)):
        encoder = field_encoder(EncoderConfig(force_field=name, tactile_features=features), spec)
        assert encoder(torch.zeros(2, 3, 7, 9)).shape == (2, features)


def test_a_name_of_an_encoder_is_given_once():
    with pytest.raises(InvalidArgumentError, match="'t3' is registered already"):
        register_tacrgb_encoder("t3", lambda size: torch.nn.Identity())


def test_two_policies_with_one_class_of_arguments_are_refused():
    class Other(diffusion.DiffusionPolicy):
        name = "other"

    specs = {"diffusion_policy": diffusion.SPEC, "other": PolicySpec(Other, diffusion.Args, diffusion.PRESETS)}
    with pytest.raises(PluginError, match=r"'diffusion_policy' and 'other' share the class of arguments Args"):
        require_distinct(specs)


def test_a_policy_whose_checkpoints_could_not_be_read_is_not_trained(tmp_path):
    @dataclasses.dataclass
    class OwnConfig(diffusion.DiffusionConfig):
        weight: float = 0.5

    class Own(diffusion.DiffusionPolicy):
        name = "own"

    args = dataclasses.replace(diffusion.PRESETS["cpu"].args, policy=OwnConfig(), demos=(), run_dir=tmp_path / "run")
    with pytest.raises(PluginError, match=r"give the class .*Own the line `Config = .*OwnConfig`"):
        PolicySpec(Own, diffusion.Args, diffusion.PRESETS).train(args)


def test_a_policy_under_another_name_than_its_own_is_refused():
    with pytest.raises(PluginError, match="register it as 'diffusion_policy'"):
        require_distinct({"mine": diffusion.SPEC})


def evaluates(process: psutil.Process) -> bool:
    with suppress(psutil.Error):  # it may have ended
        return "manifeel_ms3.evaluation.evaluate" in process.cmdline()
    return False


def test_an_evaluation_does_not_outlive_a_training_that_fails(trainer_args, monkeypatch):
    """It would go on in the folder of the run, where a resumed training evaluates the same checkpoint."""
    kwargs = '{"render_backend": "none"}'
    args = dataclasses.replace(trainer_args, save_freq=1, log_freq=1, num_eval_episodes=50, eval_env_kwargs=kwargs)
    trainer, evaluations = Trainer(args, diffusion.DiffusionPolicy, Processes("cpu")), []
    take_step = trainer.take_step

    def take_one_step() -> None:
        evaluations.extend(filter(evaluates, psutil.Process().children()))
        if evaluations:
            raise TrainingError("the loss is not a number")
        take_step()

    monkeypatch.setattr(trainer, "take_step", take_one_step)
    with pytest.raises(TrainingError):
        trainer.run()
    (evaluation,) = evaluations
    assert not evaluation.is_running()


def test_a_step_of_training_sees_crops_at_random_places(trainer_args):
    encoder = EncoderConfig("small_cnn", image_features=8, crop=24)
    images = dict(demos=(observed_sample(PEG),), obs_mode="rgb", cameras=("wrist",), image_size=32, tactile_image_size=32)
    args = dataclasses.replace(trainer_args, **images, policy=dataclasses.replace(trainer_args.policy, encoder=encoder))
    trainer, seen = Trainer(args, diffusion.DiffusionPolicy, Processes("cpu")), []
    trainer.policy.encoder.images[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    trainer.order.take = lambda count: torch.arange(count)
    for _ in range(2):
        trainer.take_step()
    assert seen[0].shape[2:] == (24, 24)
    assert not torch.equal(*seen)


def test_each_training_seed_has_an_order_of_samples_of_its_own(trainer_args, tmp_path):
    orders = []
    for seed in (0, 1):
        args = dataclasses.replace(trainer_args, seed=seed, run_dir=tmp_path / str(seed))
        orders.append(Trainer(args, diffusion.DiffusionPolicy, Processes("cpu")).order.take(20).tolist())
    assert orders[0] != orders[1]
