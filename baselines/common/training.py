"""The training loop that all policies share: set up, step, save, resume."""

import logging
import math
import random
import time
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from diffusers.optimization import get_cosine_schedule_with_warmup
from diffusers.training_utils import EMAModel
from torch.optim.lr_scheduler import LambdaLR

from manifeel_ms3.errors import FileExistsAlreadyError, InvalidArgumentError
from manifeel_ms3.evaluation.checkpoint_config import TRAINING_LOSS, TRAINING_STATE, WEIGHTS, checkpoint_config, with_implied
from manifeel_ms3.files import remove_folder, remove_leftovers
from manifeel_ms3.nested_settings import as_json
from manifeel_ms3.ownership import owned
from manifeel_ms3.paths import CHECKPOINTS, EVALUATION, LAST_LINK
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.provenance import machine
from manifeel_ms3.tasks.registry import task_spec

from .agent import spec_of
from .background_evaluation import SUCCESS, BackgroundEvaluation
from .checkpoint import (
    BROKEN_STATE,
    make_last,
    newest_checkpoint,
    pack,
    prune,
    random_state,
    read_tensors,
    require_same_config,
    save_checkpoint,
    saved_checkpoints,
    unpack,
)
from .dataset import Demonstration, SampleOrder, SequenceDataset, read_episodes, recorded_env_kwargs
from .encoders import load_pretrained
from .memory import keep_freed_memory, lay_out_channels_last
from .observation import ObservationSpec
from .policy import VisuotactilePolicy
from .pose_targets import CONTROL_MODES
from .processes import Processes
from .recent_losses import RecentLosses, TrainingError
from .run_log import RunLog, wandb_run_of
from .train_args import FREE_ON_RESUME, TrainArgs, check_evaluation, check_run, default_exp_name, planned_steps

log = logging.getLogger(__name__)
EVALUATIONS = "evaluations"
"""Folder of the checkpoints' evaluations in the folder of a run."""
RANK_SEED_STRIDE = 1_000_003
"""Difference between the noise seeds of two processes; a prime number that is larger than usual seeds."""


def train(args: TrainArgs, policy_class: type[VisuotactilePolicy]) -> Path:
    """Train a policy, and return the last checkpoint.

    Args:
        args: Settings of the run.
        policy_class: Class of the policy.

    Raises:
        InvalidArgumentError: A number is too small, the settings contradict each other (`check_run`), the device or an argument
            of the evaluations is not known, or the policy cannot learn actions of the demonstrations' control mode.
        MachineError: This machine does not have the device.
        FileExistsAlreadyError: The folder of the run has checkpoints, and is neither to be resumed nor to be overwritten.
        InUseError: Another process trains in the folder of the run.
        DemonstrationError: The demonstrations are not what the settings ask for.
        CheckpointError: The run to resume has other settings, or its checkpoint is missing or broken.
        TrainingError: The loss is not a finite number.
    """
    check_run(args)
    processes = Processes(args.device)
    args = args.with_task_defaults()
    check_evaluation(args)
    exp_name = processes.of_first(args.exp_name or default_exp_name(args, policy_class.name))
    run_dir = args.run_dir or Path("runs") / exp_name
    with ExitStack() as stack:
        processes.first_does(lambda: stack.enter_context(owned(run_dir)))
        processes.first_does(lambda: _require_free(run_dir, args))
        trainer = Trainer(replace(args, exp_name=exp_name, run_dir=run_dir), policy_class, processes)
        if processes.first:
            log.info("the run is in %s", run_dir)
        return trainer.run()


def _require_free(run_dir: Path, args: TrainArgs) -> None:
    """Check that the folder of the run has no checkpoints, unless they are to be continued or replaced.

    Raises:
        FileExistsAlreadyError: It has.
    """
    if saved_checkpoints(run_dir / CHECKPOINTS) and not (args.resume or args.overwrite):
        raise FileExistsAlreadyError(
            f"{run_dir} has the checkpoints of an earlier run; continue it with --resume, replace it with --overwrite, or "
            "give another --run-dir"
        )


class Trainer:
    """A training run: the data, the policy, and everything that changes while the policy learns.

    Args:
        args: Settings of the run, with its folder.
        policy_class: Class of the policy.
        processes: The processes of the run.

    Raises:
        InvalidArgumentError: The policy cannot learn actions of the demonstrations' control mode.
        DemonstrationError: The demonstrations are not what the settings ask for.
        CheckpointError: The run to resume has other settings, or its checkpoint is missing or broken.
    """

    def __init__(self, args: TrainArgs, policy_class: type[VisuotactilePolicy], processes: Processes):
        assert args.run_dir is not None
        self.run_dir, self.processes = args.run_dir, processes
        lr = args.public_code_lr() if args.lr is None else args.lr
        self.args = args = replace(args, lr=lr).with_task_defaults()
        assert args.env_id is not None
        self.device = processes.device
        keep_freed_memory(self.device)
        seed_everything(args.seed)
        spec = spec_of(vars(args))
        env_kwargs, mode = learnable_task(args, policy_class)
        episodes = read_episodes(args.demos, args.env_id, spec, args.num_demos)
        spec = with_taxel_shape(spec, episodes[0])
        horizons = (args.policy.obs_horizon, args.policy.pred_horizon, args.policy.action_horizon)
        self.dataset = SequenceDataset(episodes, spec, *horizons, self.device, mode if args.policy.predicts_targets else None)
        self.batch_size = args.batch_size * self.processes.count
        self.total_steps = planned_steps(args, self.dataset.num_episodes, len(self.dataset), self.batch_size)
        amount = dict(total_steps=self.total_steps, num_processes=processes.count)
        self.config = run_config(args, policy_class, self.dataset, env_kwargs) | amount

        self.policy = self._make_policy(policy_class)
        self.optimizer = torch.optim.AdamW(self.policy.parameters(), lr, args.betas, weight_decay=args.weight_decay, fused=True)
        self.schedule = get_cosine_schedule_with_warmup(self.optimizer, args.warmup_steps, self.total_steps)
        self.ema = EMAModel(
            self.policy.parameters(), args.ema_max_decay, use_ema_warmup=True, power=args.ema_power, inv_gamma=1.0, foreach=True
        )
        self.order = SampleOrder(len(self.dataset), args.seed)
        self.losses = RecentLosses(args.log_freq, self.device)
        self.step, self.begin = 0, time.time()
        if args.resume:
            self._resume()
        elif not self.processes.first:  # each process draws its own noise
            torch.manual_seed(args.seed + RANK_SEED_STRIDE * self.processes.rank)

        self.model = self.processes.with_mean_gradients(self.policy).train()
        evaluation = (args.num_eval_episodes, args.num_eval_envs, args.eval_env_kwargs, args.device, args.capture_video)
        self.evaluation = BackgroundEvaluation(self.run_dir / EVALUATIONS, *evaluation)
        self.log = self._open_log() if processes.first else None

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.run_dir / CHECKPOINTS

    def run(self) -> Path:
        """Train to the last step, and return the last checkpoint.

        An evaluation that is running when an exception ends the training is stopped, too.

        Raises:
            TrainingError: The loss is not a finite number.
        """
        with self.log or nullcontext():
            try:
                self._train()
                return self._finish()
            finally:
                self.evaluation.stop()

    def _train(self) -> None:
        """Train to the last step, with checkpoints and logs on the way."""
        with progress_bar(disable=not self.processes.first) as bar:
            task = bar.add_task("training", total=self.total_steps, completed=self.step)
            while self.step < self.total_steps:
                self.take_step()
                due = self.step % self.args.save_freq == 0 or self._is_evaluated(self.step) or self.step == self.total_steps
                if self.losses.full or due:  # the only place that waits for the device
                    bar.update(task, description=f"training, loss {self._log_loss():.4f}")
                if due:
                    self._save_and_evaluate()
                if self.step % self.args.log_freq == 0:
                    self._log_evaluations()
                bar.update(task, completed=self.step)

    def take_step(self) -> None:
        """Take one gradient step on the next batch."""
        batch = self.order.take(self.batch_size)[self.processes.rank :: self.processes.count]
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.args.precision == "bf16"):
            loss = self.model(*self.dataset.sample(batch.to(self.device)))
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        self.schedule.step()
        self.ema.step(self.policy.parameters())
        self.losses.add(loss, batch)
        self.step += 1

    def save(self) -> Path:
        """Write a checkpoint of the present step, make it the last, and return its folder.

        All processes call it together, and the first one writes.
        """
        folder, random_states = self.checkpoints / f"{self.step:08d}", self.processes.of_all(random_state())
        if not self.processes.first:
            return folder
        averaged = dict(zip(self.policy.parameters(), self.ema.shadow_params, strict=True))
        of_names = {name: averaged[weight] for name, weight in self.policy.named_parameters(remove_duplicate=False)}
        weights = self.policy.state_dict() | of_names
        state = pack(self.optimizer, self.policy, random_states) | self.order.state_dict()
        cost = dict(trained_on=machine(), training_seconds=round(time.time() - self.begin, 3))
        save_checkpoint(folder, self.config | cost | dict(step=self.step), weights, state)
        make_last(folder)
        return folder

    def _make_policy(self, policy_class: type[VisuotactilePolicy]) -> VisuotactilePolicy:
        """The policy before training, on the device."""
        policy = policy_class(self.args.policy, self.dataset.spec, self.config["action_dim"]).to(self.device)
        lay_out_channels_last(policy)
        if not self.args.resume:
            self.config["tacrgb_weights"] = load_pretrained(policy, self.args.tacrgb_weights)
        policy.fit_normalizers(self.dataset.observations, self.dataset.actions_to_fit)
        if self.args.compile:
            policy.encoder.compile()
            policy.action_network.compile()
        return policy

    def _resume(self) -> None:
        """Continue from the newest checkpoint, as if the run had not stopped.

        On a CPU this is so bit for bit with up to two processes; the sum over more may round differently in another order.
        """
        last = newest_checkpoint(self.checkpoints)
        saved = with_implied(checkpoint_config(last))
        require_same_config(saved, self.config, FREE_ON_RESUME, last)
        self.config["tacrgb_weights"] = saved.get("tacrgb_weights")  # those that it began with; their file may be gone
        state = read_tensors(last / TRAINING_STATE, BROKEN_STATE)
        self.order.load_state_dict(state)
        unpack(state, self.optimizer, self.policy, last, self.processes.rank)
        averaged = read_tensors(last / WEIGHTS)
        self.ema.shadow_params = [averaged[name].to(self.device) for name, _ in self.policy.named_parameters()]
        self.ema.optimization_step = self.step = saved["step"]
        fast_forward(self.schedule, self.step)
        self.begin -= saved["training_seconds"]

    def _open_log(self) -> RunLog:
        """Prepare the folder of the run and open its log; files of an earlier run stay only if this run continues it."""
        for folder in (self.run_dir, self.checkpoints):
            remove_leftovers(folder)
        if self.args.overwrite:
            evaluations = self.run_dir.glob(f"{Path(EVALUATION).stem}.*")  # the result, and episodes of an unfinished one
            for path in (self.checkpoints, self.run_dir / EVALUATIONS, *evaluations):
                remove_folder(path) if path.is_dir() else path.unlink(missing_ok=True)
        opened = RunLog(self.run_dir, self.config, self.step, wandb_run_of(self.args, str(self.config["policy_name"])))
        if self.args.resume:
            make_last(newest_checkpoint(self.checkpoints))
            evaluated = {entry["step"] for entry in opened.entries if SUCCESS in entry}
            for checkpoint in saved_checkpoints(self.checkpoints):
                if self._is_evaluated(int(checkpoint.name)) and int(checkpoint.name) not in evaluated:
                    self.evaluation.submit(checkpoint)
        return opened

    def _is_evaluated(self, step: int) -> bool:
        """Whether the checkpoint of a step is evaluated."""
        due = step % (self.args.eval_freq or self.args.save_freq) == 0 or step == self.total_steps
        return self.args.num_eval_episodes > 0 and due

    def _log_loss(self) -> float:
        """Log the mean loss since the last entry, and return it.

        Raises:
            TrainingError: A loss of this process, or of another one, is not a finite number.
        """
        mean, wrong = 0.0, None
        try:
            mean = self.losses.take_mean(self.step, self.dataset.names)
        except TrainingError as error:
            wrong = error
        for raised in self.processes.of_all(wrong):  # the others would wait for ever for the one that gives up
            if raised:
                raise raised
        if self.log:
            epoch = self.step / math.ceil(len(self.dataset) / self.batch_size)
            seconds = time.time() - self.begin
            scalars = {TRAINING_LOSS: mean, "charts/learning_rate": self.schedule.get_last_lr()[0], "charts/epoch": epoch}
            scalars |= {"time/total_seconds": seconds, "time/iterations_per_second": self.step / max(seconds, 1e-9)}
            self.log.write(dict(step=self.step) | scalars)
        return mean

    def _save_and_evaluate(self) -> None:
        """Write a checkpoint, queue its evaluation, and delete old checkpoints."""
        if self.log:
            self.log.sync()
        checkpoint = self.save()
        if self.log:
            if self._is_evaluated(self.step):
                self.evaluation.submit(checkpoint)
            prune(self.checkpoints, self.args.keep, self.evaluation.in_use)

    def _log_evaluations(self, wait: bool = False) -> None:
        """Log the evaluations that have finished; wait for all of them if asked."""
        if self.log:
            for entry in self.evaluation.finished(wait):
                self.log.write(entry, self.evaluation.video_of(int(entry["step"])))

    def _finish(self) -> Path:
        """Leave the other processes, wait for the evaluations, and return the last checkpoint."""
        del self.model  # before the group of processes, which it may not outlive
        self.processes.close()  # now, because a process that waits in NCCL's barrier gives up after 10 minutes
        if self.log:
            self._log_evaluations(wait=True)
            prune(self.checkpoints, self.args.keep, set())
        return self.checkpoints / LAST_LINK


def seed_everything(seed: int) -> None:
    """Seed every global random number generator that training or a library draws from."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 (libraries draw from it)
    torch.manual_seed(seed)


def with_taxel_shape(spec: ObservationSpec, episode: Demonstration) -> ObservationSpec:
    """The observations, with the shape of force fields that an episode has."""
    shapes = {episode[key].shape[1:3] for key in spec.force_fields}
    return replace(spec, taxel_shape=shapes.pop()) if shapes else spec


def learnable_task(args: TrainArgs, policy_class: type[VisuotactilePolicy]) -> tuple[dict, str]:
    """The arguments of the task with which the demonstrations were recorded, and the control mode of their actions.

    Raises:
        InvalidArgumentError: The policy cannot learn actions of their control mode.
        DemonstrationError: Two files were recorded with different arguments.
    """
    assert args.env_id is not None
    env_kwargs = recorded_env_kwargs(args.demos)
    mode = task_spec(args.env_id).control_mode(env_kwargs)
    known, learner = policy_class.control_modes, f"the policy {policy_class.name!r}"
    if args.policy.predicts_targets:
        known, learner = CONTROL_MODES, "a policy with the action_form 'target'"
    if known is not None and mode not in known:
        raise InvalidArgumentError(
            f"the actions of {', '.join(map(str, args.demos))} are of the control mode {mode!r}, which {learner} cannot learn; "
            f"record them in one of {list(known)}, or train another"
        )
    return env_kwargs, mode


def run_config(args: TrainArgs, policy_class: type[VisuotactilePolicy], dataset: SequenceDataset, env_kwargs: dict) -> dict:
    """The settings of a run, and the facts of its data that policy and evaluation depend on, in types that json can hold."""
    settings = {name: value for name, value in as_json(args).items() if name != "wandb_entity"}  # personal, so not published
    return settings | dict(
        policy_name=policy_class.name,
        action_dim=dataset.actions.shape[1],
        taxel_shape=list(dataset.spec.taxel_shape),
        num_demos=dataset.num_episodes,
        num_samples=len(dataset),
        env_kwargs=env_kwargs,
    )


def fast_forward(schedule: LambdaLR, steps: int) -> None:
    """Set a new schedule, and its optimiser's learning rates, to where they are after a number of steps."""
    schedule.last_epoch = steps
    for group, base_lr, factor in zip(schedule.optimizer.param_groups, schedule.base_lrs, schedule.lr_lambdas, strict=True):
        group["lr"] = base_lr * factor(steps)
