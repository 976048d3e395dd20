"""Cost of jobs on this machine, estimated from similar jobs that were done here, or else from short trials."""

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from baselines.common.agent import spec_of
from baselines.common.memory import lay_out_channels_last
from baselines.common.observation import POSE
from baselines.common.train_args import planned_steps
from baselines.registry import policy_spec, preset_cli
from manifeel_ms3.evaluation.policy import BATCH_SIZES
from manifeel_ms3.files import write_json
from manifeel_ms3.ownership import owned
from manifeel_ms3.provenance import machine
from manifeel_ms3.tasks.registry import all_tasks, make_env, task_spec
from manifeel_ms3.workers import torch_threads

from .command_lines import device_arguments, train_flags, training_args
from .jobs import DONE, read_status
from .planning import Job
from .study import KINDS, OBS_MODE, SIMULATING
from .work import without_amounts, work_of

TRIALS = "trials.json"
"""Name of the file of measured trials, in the folder of all jobs."""
SIMULATION_STEPS = 20
"""Number of control steps in a trial of a simulation; set once, not tuned."""
GRADIENT_STEPS = 2
"""Number of gradient steps in a trial of training, after a first one that counts only if it is long; set once, not tuned."""
LONG_CALL = 10.0
"""Time in s of a first call beyond which it is not repeated, as the initialization of libraries is a small part of it; set
once, not tuned."""
QUICK_STEP = 1.0
"""Time in s below which the gradients of a whole batch are measured on the CPU; set once, not tuned."""
TRIAL_BATCH = 2
"""Largest batch of a trial on the CPU that would take longer; set once, not tuned. The paper's batches would take
17 GB there, and 4 samples of its UniT encoder 9 GB."""
ACTION_SIZE = 7
"""Size of the made-up actions: pose and gripper. The cost of a network does not depend on it measurably."""


@dataclass(frozen=True)
class CostEstimate:
    """How long a job will take."""

    seconds: float
    """Wall-clock time with the resources that the study gives the job."""
    source: str
    """Origin of the estimate: "runs here" or "a trial"."""


@dataclass(frozen=True)
class Trial:
    """A short piece of work whose time an estimate is made from."""

    measure: Callable[..., float]
    """Function that returns the seconds of one step."""
    arguments: tuple[str, ...]
    """Arguments of the function."""
    threads: int = 1
    """Number of CPU threads of torch, which is that of the job. With more threads than idle cores, a step takes 100 times as
    long, since they wait for each other."""

    @property
    def key(self) -> str:
        """Hash of what is measured and of the machine; the name under which the outcome is kept."""
        content = json.dumps([self.measure.__name__, self.arguments, self.threads, machine()], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def seconds(self, root: Path) -> float:
        """The outcome; it is measured at the first time and then kept in a file under `root`."""
        known: dict[str, Any] = read_status(root / TRIALS)
        if self.key not in known:
            what = f"{self.measure.__name__}: {', '.join(self.arguments)}"
            with torch_threads(self.threads):
                seconds = self.measure(*self.arguments)
            with owned(root / TRIALS):  # another study on the same root may have added its own meanwhile
                known = read_status(root / TRIALS) | {self.key: dict(seconds=seconds, what=what)}
                write_json(root / TRIALS, known)
        return known[self.key]["seconds"]


def estimate(job: Job, root: Path, workers: int, gpus: float = 0.0) -> CostEstimate | None:
    """How long a job will take, from runs or else from trials; None for the pretraining of an encoder, which has no trials.

    Args:
        job: The job.
        root: Folder of all jobs.
        workers: Number of processes that simulate, or of threads that train.
        gpus: Number of GPUs that the study gives the job; trials run on the CPU without one, as the job does.
    """
    known = estimate_from_runs(job, seconds_of_runs(root), workers, gpus)
    if known or job.kind == "pretrain":
        return known
    return CostEstimate(_unit_seconds(job, root, workers, gpus) * _units(job), "a trial")


def estimate_from_runs(job: Job, runs: dict[str, float], workers: int, gpus: float = 0.0) -> CostEstimate | None:
    """How long a job will take if jobs like it were done here; None if there were none.

    Args:
        job: The job.
        runs: What `seconds_of_runs` gives.
        workers: Number of processes that simulate.
        gpus: Number of GPUs that the study gives the job.
    """
    seconds = runs.get(work_of(job, gpus))
    return None if seconds is None else CostEstimate(seconds * _units(job) / _parallel(job, workers), "runs here")


def seconds_of_runs(root: Path) -> dict[str, float]:
    """Median seconds of one demonstration, gradient step or episode with one process, by the work that was done.

    Jobs count that were done on a machine like this one; those that differ in amounts and seeds alone are the same work.

    Args:
        root: Folder of all jobs.
    """
    here, seconds = machine(), dict[str, list[float]]()
    for kind in KINDS:
        for path in root.glob(f"{kind}/*/{DONE}"):
            ran_on, work, took = _run(path, path.stat().st_mtime)
            if ran_on == here:
                seconds.setdefault(work, []).append(took)
    return {work: float(np.median(took)) for work, took in seconds.items()}


@cache
def _run(path: Path, _changed: float) -> tuple[Any, str, float]:
    """Machine, work and seconds of a unit of a job that was done.

    There is no machine if the status file was cut off, or if it is of an older version, which does not tell the work.
    """
    status = read_status(path)
    if not {"machine", "work"} <= status.keys():
        return None, "", 0.0
    took = status["seconds"] / max(status["units"], 1) * status["parallel"]
    return status["machine"], status["work"], took


def _parallel(job: Job, workers: int) -> int:
    """Number of processes that share the work of a job."""
    return workers if job.kind in SIMULATING else 1


def _units(job: Job) -> int:
    """Number of demonstrations, gradient steps or episodes of a job."""
    settings = job.settings
    if job.kind == "record":
        return settings["num"]
    if job.kind == "pretrain":
        return 1
    if job.kind == "evaluate":
        return settings["episodes"] * settings["checkpoints"]
    args, record = training_args(job), job.needs[0]
    demos = record.settings["num"] if args.num_demos is None else args.num_demos
    steps = _demonstration_steps(record.settings["env_id"])
    samples = demos * max(steps - args.policy.action_horizon + 1, 1)  # as `SequenceDataset` counts them
    return planned_steps(args, demos, samples, args.batch_size)


def _demonstration_steps(env_id: str) -> float:
    """Mean number of control steps of a demonstration; the time limit of a task where it is not known."""
    return task_spec(env_id).demo_steps or task_spec(env_id).max_episode_steps


# -------------------------------------------------------------------- trials


def trials_of(job: Job, threads: int = 1, gpus: float = 0.0) -> tuple[Trial, ...]:
    """The trials from which the cost of a job is estimated; none for the pretraining of an encoder.

    Args:
        job: The job.
        threads: Number of CPU threads of a training; the processes of other jobs have one each.
        gpus: Number of GPUs that the study gives the job.
    """
    if job.kind == "record":
        return (_simulation_trial(job, OBS_MODE),)
    if job.kind == "pretrain":
        return ()
    train = job if job.kind == "train" else job.needs[0]
    device = _device(gpus)
    preset, *flags = train_flags(without_amounts(train.settings))
    where = ["--device", "cuda"] if device == "cuda" else device_arguments("train", 0)
    network = train.settings["policy"], preset, *where, *flags
    if job.kind == "train":
        return (Trial(gradient_step, network, threads),)
    as_evaluated = "--device", device, "--batch-size", str(_batch_size(gpus))
    return _simulation_trial(train.needs[0], training_args(train).obs_mode), Trial(inference, (*network, *as_evaluated))


def _device(gpus: float) -> str:
    """Device of the trials of a job to which the study gives so many GPUs."""
    return "cuda" if gpus and torch.cuda.is_available() else "cpu"


def _batch_size(gpus: float) -> int:
    """Number of episodes that the policy of an evaluation answers together."""
    return BATCH_SIZES[_device(gpus)]


def _unit_seconds(job: Job, root: Path, workers: int, gpus: float) -> float:
    """Seconds of one demonstration, gradient step or episode.

    In an evaluation, a worker waits for the policy, whose process answers all workers, a batch of them at a time.
    """
    trials = trials_of(job, workers, gpus)
    seconds = [trial.seconds(root) for trial in trials]
    if job.kind == "train":
        return seconds[0]
    env_id = job.settings["env_id"]
    if job.kind == "record":
        return seconds[0] * _demonstration_steps(env_id) / workers
    limit = json.loads(job.settings["env_kwargs"]).get("max_episode_steps") or task_spec(env_id).max_episode_steps
    answer = seconds[1] / training_args(job.needs[0]).policy.action_horizon
    return limit * max((seconds[0] + answer) / workers, answer / min(_batch_size(gpus), workers))


def _simulation_trial(record: Job, obs_mode: str) -> Trial:
    settings = record.settings
    return Trial(simulation_step, (settings["env_id"], obs_mode, settings["camera"], settings["env_kwargs"]))


def simulation_step(env_id: str, obs_mode: str, camera: str, env_kwargs: str) -> float:
    """Seconds of a control step with a random action.

    Args:
        env_id: Id of the task.
        obs_mode: Observation mode.
        camera: Name of the camera.
        env_kwargs: Further arguments of the task, as json.
    """
    sensing = dict(obs_mode=obs_mode, cameras=(camera,), tactile_sensors=("right",), sim_backend="physx_cpu")
    env = make_env(env_id, **sensing | json.loads(env_kwargs))
    env.reset(seed=0)
    seconds = _seconds(lambda: env.step(env.action_space.sample()), SIMULATION_STEPS)
    env.close()
    return seconds


def gradient_step(policy: str, *flags: str) -> float:
    """Seconds of a gradient step of a policy on made-up observations.

    On the CPU, a batch that would take long is estimated from a small one, as the time of its gradients grows with the number
    of samples. The time of the optimizer, which depends on the number of weights alone, is added once.

    Args:
        policy: Registered name of the policy.
        flags: Preset and flags of training.
    """
    network, args, obs, actions = _made_up(policy, flags)
    optimizer = torch.optim.AdamW(network.parameters(), fused=True)
    batches = args.batch_size / len(actions)

    def compute_gradients() -> None:
        with torch.autocast(args.device, torch.bfloat16, enabled=args.precision == "bf16"):
            loss = network(obs, actions)
        optimizer.zero_grad()
        loss.backward()
        loss.item()

    def update_weights() -> None:
        optimizer.step()
        next(network.parameters()).flatten()[0].item()  # waits for a GPU, as `loss.item()` does

    gradients = _seconds(compute_gradients, GRADIENT_STEPS) * batches
    if batches > 1 and gradients < QUICK_STEP:
        rows = torch.arange(args.batch_size) % len(actions)
        obs, actions = {key: value[rows] for key, value in obs.items()}, actions[rows]
        gradients = _seconds(compute_gradients, GRADIENT_STEPS)
    return gradients + _seconds(update_weights, GRADIENT_STEPS)


def inference(policy: str, *flags: str) -> float:
    """Seconds in which a policy generates the actions of one batch.

    Args:
        policy: Registered name of the policy.
        flags: Preset and flags of training, with the device and the batch size of the evaluation.
    """
    network, args, obs, actions = _made_up(policy, flags)
    network.eval()
    generators = [torch.Generator() for _ in actions]
    return _seconds(lambda: network.sample(obs, args.inference_steps, generators).cpu(), 1)  # `cpu` waits for a GPU


def _made_up(policy: str, flags: tuple[str, ...]) -> tuple[Any, Any, dict[str, torch.Tensor], torch.Tensor]:
    """An untrained policy, its training arguments, and a batch of random observations and actions, on the CPU a small one."""
    preset, *rest = flags
    any_task = next(iter(all_tasks()))
    asked = [preset, "--demo-path", "-", "--env-id", any_task, *rest]
    args = preset_cli(policy_spec(policy), asked).with_task_defaults()
    spec, horizon = spec_of(vars(args)), args.policy.obs_horizon
    batch = min(args.batch_size, TRIAL_BATCH) if args.device == "cpu" else args.batch_size
    network = policy_spec(policy).policy_class(args.policy, spec, ACTION_SIZE).to(args.device)
    lay_out_channels_last(network)  # as in training
    shapes = {key: (batch, horizon, spec.size_of(key), spec.size_of(key), 3) for key in spec.images}
    obs = {key: torch.randint(255, shape, dtype=torch.uint8, device=args.device) for key, shape in shapes.items()}
    obs |= {key: torch.rand(batch, horizon, *spec.taxel_shape, 3, device=args.device) for key in spec.force_fields}
    obs[POSE] = torch.rand(batch, horizon, spec.pose_features, device=args.device)
    return network, args, obs, torch.rand(batch, args.policy.pred_horizon, ACTION_SIZE, device=args.device)


def _seconds(do: Callable[[], Any], repeats: int) -> float:
    """Mean seconds of a call, after a first call that counts only if it is long."""
    begin = time.perf_counter()
    do()
    first = time.perf_counter() - begin
    if first > LONG_CALL:
        return first
    begin = time.perf_counter()
    for _ in range(repeats):
        do()
    return (time.perf_counter() - begin) / repeats
