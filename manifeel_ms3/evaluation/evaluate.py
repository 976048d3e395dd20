r"""Evaluate a policy on fixed seeds.

    python -m manifeel_ms3.evaluation.evaluate --checkpoint runs/x/checkpoints/last
    python -m manifeel_ms3.evaluation.evaluate --policy my_module:MyPolicy --env-id ManiFeel-PegInsertion-v1 \
        --obs-mode rgb+tacff

The result is one json file whose form `data/evaluation_schema.json` defines: versions, git commit, the policy's configuration,
the outcome of every episode, and success rates with Wilson intervals. A policy that raises an error, returns NaN or an action
of the wrong shape, or does not answer in time fails that episode, and the result holds the reason; the evaluation goes on.
"""

import json
import logging
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import tyro

from manifeel_ms3.command_line import json_object, missing_extras_named, run
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.tasks.registry import evaluation_seeds, make_env, task_spec
from manifeel_ms3.workers import WorkerDiedError, WorkerPool

from .checkpoint_config import CheckpointError, checkpoint_config
from .policy import Policy, PolicySource
from .result import result_of, write_result
from .rollout import EpisodeOutcome, evaluate_episode

log = logging.getLogger(__name__)
SENSING = ("obs_mode", "cameras", "tactile_sensors")
"""Arguments of the environment that a checkpoint's configuration holds."""


@dataclass
class Args:
    """Arguments of an evaluation."""

    checkpoint: Path | None = None
    """Checkpoint folder, with config.json and weights."""
    policy: str | None = None
    """Policy to evaluate instead of a checkpoint: a class that can be imported ("module:Class"), or the address of a server
    ("http://localhost:8000")."""
    policy_kwargs: str = "{}"
    """Keyword arguments of the policy, as json."""
    env_id: str | None = None
    """Id of the task; the checkpoint's task if not given."""
    obs_mode: str | None = None
    """Observation mode of the policy, such as rgb+tacff; a checkpoint brings its own."""
    cameras: tuple[str, ...] | None = None
    """Cameras that the policy observes, for a --policy; the task's policy camera if not given. A checkpoint brings its own."""
    tactile_sensors: tuple[str, ...] = ("right",)
    """Finger pads that the policy observes, for a --policy: left, right, or both. A checkpoint brings its own."""
    out: Path | None = None
    """Path of the result file; evaluation.json in the checkpoint's run folder, or in the working directory, if not given."""
    episodes: int = 50
    """Number of episodes; their seeds are 100000 and the following numbers."""
    workers: int = 1
    """Number of processes that run episodes side by side."""
    inference_steps: int | None = None
    """Number of denoising or integration steps for one action chunk; the checkpoint's own number if not given."""
    step_timeout: float = 60.0
    """Longest time that the policy may take for one action, in s."""
    env_kwargs: str = "{}"
    """Arguments of the task as json, such as '{"fit": "loose"}'."""
    videos: tuple[int, ...] = ()
    """Numbers of the episodes, counted from 0, that are recorded as videos with all cameras and touch; the videos go into the
    folder videos beside the result."""


@dataclass(frozen=True)
class Evaluation:
    """A policy, and the task that it is evaluated on."""

    source: PolicySource
    """Place that the policy comes from."""
    env_id: str
    """Id of the task."""
    env_kwargs: dict[str, Any]
    """Arguments of `gym.make` for the task."""
    config: dict[str, Any]
    """Configuration of the policy, as the result holds it."""


def main(args: Args) -> Path:
    """Evaluate a policy, and return the path of the result file.

    Raises:
        CheckpointError: The checkpoint cannot be used.
        PolicyError: The policy cannot be made.
        InvalidArgumentError: The arguments do not say what to evaluate, or on which task.
    """
    evaluation = evaluation_from_args(args)
    seeds = evaluation_seeds(args.episodes)
    if wrong := [number for number in args.videos if not 0 <= number < len(seeds)]:
        raise InvalidArgumentError(f"--videos {wrong} cannot be recorded: the episodes are 0 to {len(seeds) - 1}")
    outcomes = run_episodes(evaluation, seeds, args.workers, args.step_timeout)
    out = args.out or (args.checkpoint.parent.parent if args.checkpoint else Path()) / "evaluation.json"
    write_result(result_of(evaluation.env_id, evaluation.env_kwargs, evaluation.config, outcomes), out)
    for number in args.videos:
        write_video(evaluation, outcomes[number].seed, out.parent / "videos")
    log.info("%s", out)
    return out


def evaluation_from_args(args: Args) -> Evaluation:
    """The evaluation that the arguments, and the checkpoint's configuration if there is one, describe.

    Raises:
        CheckpointError: The checkpoint's configuration is missing or incomplete.
        UnknownNameError: The task is not registered.
        InvalidArgumentError: Neither a checkpoint nor a policy is given, or both, or a policy without its task.
    """
    if (args.checkpoint is None) == (args.policy is None):
        raise InvalidArgumentError("give either --checkpoint, or --policy with --env-id and --obs-mode")
    extra = dict(sim_backend="physx_cpu") | json_object("--env-kwargs", args.env_kwargs)
    policy_kwargs = json_object("--policy-kwargs", args.policy_kwargs)
    if args.checkpoint is not None:
        return _of_checkpoint(args.checkpoint, policy_kwargs | dict(inference_steps=args.inference_steps), extra)
    if args.env_id is None or args.obs_mode is None:
        raise InvalidArgumentError("a --policy of your own needs --env-id and --obs-mode")
    env_id = task_spec(args.env_id).env_id
    sensing = dict(obs_mode=args.obs_mode, cameras=args.cameras, tactile_sensors=args.tactile_sensors)
    source = PolicySource(policy=args.policy, kwargs=args.policy_kwargs)
    config = dict(policy_name=args.policy, policy_kwargs=policy_kwargs, obs_mode=args.obs_mode)
    return Evaluation(source, env_id, {n: v for n, v in sensing.items() if v is not None} | extra, config)


def _of_checkpoint(checkpoint: Path, kwargs: dict[str, Any], extra: dict[str, Any]) -> Evaluation:
    config = checkpoint_config(checkpoint)
    if missing := [name for name in ("env_id", *SENSING) if name not in config]:
        raise CheckpointError(f"{checkpoint}: its config.json lacks {missing}; train the policy again")
    source = PolicySource(checkpoint, kwargs=json.dumps(kwargs))
    sensing = {name: config[name] for name in SENSING}
    return Evaluation(source, task_spec(config["env_id"]).env_id, sensing | extra, config)


def run_episodes(evaluation: Evaluation, seeds: list[int], workers: int, step_timeout: float) -> list[EpisodeOutcome]:
    """Outcomes in the seeds' order; an episode whose process dies has failed."""
    outcomes: dict[int, EpisodeOutcome] = {}
    with progress_bar() as bar, WorkerPool(workers, partial(_make_env_and_policy, evaluation)) as pool:
        task = bar.add_task("evaluating", total=len(seeds))
        for seed in seeds:
            pool.submit(partial(_run_seed, step_timeout=step_timeout), seed)
        for finished in pool.as_finished():
            try:
                outcomes[finished.task] = finished.result()
            except WorkerDiedError as error:
                reason = f"the policy's process ended with exit code {error.exit_code}: it crashed, or hung for good"
                outcomes[finished.task] = EpisodeOutcome(finished.task, False, False, 0, 0.0, 0.0, reason)
            successes = sum(outcome.success_once for outcome in outcomes.values())
            bar.update(task, advance=1, description=f"evaluating, {successes} of {len(outcomes)} succeed")
    return [outcomes[seed] for seed in seeds]


def _make_env_and_policy(evaluation: Evaluation) -> tuple[gym.Env, Policy]:
    """In a worker process: what it keeps from one episode to the next."""
    return make_env(evaluation.env_id, **evaluation.env_kwargs), evaluation.source.make()


def _run_seed(env_and_policy: tuple[gym.Env, Policy], seed: int, step_timeout: float) -> EpisodeOutcome:
    env, policy = env_and_policy
    return evaluate_episode(env, policy, seed, step_timeout=step_timeout)


def write_video(evaluation: Evaluation, seed: int, folder: Path) -> Path:
    """Run an episode again with every camera and touch, and write it as an MP4 file into a folder.

    Raises:
        MissingExtraError: The extra `report`, which encodes videos, is not installed.
    """
    with missing_extras_named():
        from .video import encode_video, record_episode

    _, frames = record_episode(evaluation.env_id, evaluation.env_kwargs, evaluation.source.make(), seed)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{seed}.mp4"
    path.write_bytes(encode_video(frames))
    return path


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
