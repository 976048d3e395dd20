r"""Evaluate a policy on fixed seeds.

    python -m manifeel_ms3.evaluation.evaluate --checkpoint runs/x/checkpoints/last
    python -m manifeel_ms3.evaluation.evaluate --policy my_module:MyPolicy --env-id ManiFeel-PegInsertion-v1 \
        --obs-mode rgb+tacff

The result is one json file whose form `data/evaluation_schema.json` defines: versions, git commit, the policy's configuration,
the outcome of every episode, and success rates with Wilson intervals. A policy that raises an error, returns NaN or an action
of the wrong shape, or does not answer in time fails that episode, and the result holds the reason; the evaluation goes on. A
policy server that cannot be reached ends the evaluation.

Every episode is on the disk as soon as it is finished. After Ctrl-C, or whatever else ends the evaluation, the same command
goes on with the other episodes.
"""

import json
import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import tyro

from manifeel_ms3.command_line import json_object, missing_extras_named, run
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.files import atomic_write
from manifeel_ms3.ownership import owned
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.tasks.registry import evaluation_seeds, make_env, task_spec
from manifeel_ms3.workers import WorkerDiedError, WorkerPool

from .checkpoint_config import CheckpointError, checkpoint_config
from .journal import Journal
from .policy import Policy, PolicySource
from .redaction import redacted, secrets_in, without_secrets
from .result import as_published, provenance, published_config, result_of, write_result
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
    """Keyword arguments of the policy, as json. Passwords and tokens among them are left out of the result."""
    env_id: str | None = None
    """Id of the task; the checkpoint's task if not given."""
    obs_mode: str | None = None
    """Observation mode of the policy, such as rgb+tacff; a checkpoint brings its own."""
    cameras: tuple[str, ...] | None = None
    """Cameras that the policy observes, for a --policy; the task's policy camera if not given. A checkpoint brings its own."""
    tactile_sensors: tuple[str, ...] = ("right",)
    """Finger pads that the policy observes, for a --policy: left, right, or both. A checkpoint brings its own."""
    out: Path | None = None
    """Path of the result file; evaluation.json in the checkpoint's run folder, or in the working directory, if not given. The
    finished episodes of an evaluation that was interrupted are in <name>.episodes.jsonl beside it."""
    overwrite: bool = False
    """Discard the finished episodes of an evaluation that was interrupted, and begin again. Without this flag the evaluation
    goes on if nothing has changed, and is refused otherwise. It cannot be known whether the policy of a server has changed."""
    episodes: int = 50
    """Number of episodes; their seeds are 100000 and the following numbers."""
    workers: int = 1
    """Number of processes that run episodes side by side."""
    inference_steps: int | None = None
    """Number of denoising or integration steps for one action chunk; the checkpoint's own number if not given."""
    step_timeout: float = 60.0
    """Longest time that the policy may take for one action, in s."""
    env_kwargs: str = "{}"
    """Arguments of the task as json, such as '{"fit": "tight"}'."""
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
    """Configuration of the policy; the result holds it without paths, passwords and tokens."""


def main(args: Args) -> Path:
    """Evaluate a policy, and return the path of the result file.

    Raises:
        CheckpointError: The checkpoint cannot be used.
        PolicyError: The policy cannot be made.
        PolicyUnavailableError: The policy's server cannot be reached.
        InvalidArgumentError: The arguments do not say what to evaluate, or on which task.
        OtherEvaluationError: Another evaluation of this result was interrupted.
        InUseError: Another process writes this result.
        FileWriteError: The result cannot be written.
    """
    evaluation = evaluation_from_args(args)
    seeds = evaluation_seeds(args.episodes)
    out = args.out or (args.checkpoint.parent.parent if args.checkpoint else Path()) / "evaluation.json"
    _check_outputs(args, evaluation, seeds, out)
    with owned(out):
        journal = Journal(out, _identity(evaluation, args.step_timeout), seeds, args.overwrite)
        if journal.outcomes:
            log.info("%s has %d finished episodes; the evaluation goes on", journal.path, len(journal.outcomes))
        with journal.kept():
            run_episodes(evaluation, journal.remaining, args.workers, args.step_timeout, journal.add)
            write_result(_result(evaluation, journal.in_order), out)
    for number in args.videos:
        write_video(evaluation, seeds[number], out.parent / "videos")
    log.info("%s", out)
    return out


def _check_outputs(args: Args, evaluation: Evaluation, seeds: list[int], out: Path) -> None:
    """Check before the first episode what would else fail after the last one.

    Raises:
        InvalidArgumentError: The result is a folder, or there is no episode that a video is asked of.
        ResultError: The arguments cannot be part of a result.
        MissingExtraError: Videos are asked for, and the extra `report` is not installed.
    """
    try:
        if out.is_dir():
            raise InvalidArgumentError(f"--out {out} is a folder; give the path of a file, such as {out / 'evaluation.json'}")
    except OSError as error:
        raise InvalidArgumentError(f"--out {out} cannot be written ({error.strerror}); give another path") from error
    if wrong := [number for number in args.videos if not 0 <= number < len(seeds)]:
        raise InvalidArgumentError(f"--videos {wrong} cannot be recorded: the episodes are 0 to {len(seeds) - 1}")
    if args.videos:
        with missing_extras_named():
            from . import video  # noqa: F401  (only to see whether it can be imported)
    as_published(_result(evaluation, [EpisodeOutcome(seeds[0], False, False, 0, 0.0, 0.0)]), out)


def _identity(evaluation: Evaluation, step_timeout: float) -> dict[str, Any]:
    """Everything that outcomes depend on, as far as it can be known."""
    return dict(
        env_id=evaluation.env_id,
        env_kwargs=evaluation.env_kwargs,
        policy_hash=evaluation.source.fingerprint(),
        policy_kwargs=redacted(json.loads(evaluation.source.kwargs)),
        config=published_config(evaluation.config),
        step_timeout=step_timeout,
        **provenance(evaluation.env_id),
    )


def _result(evaluation: Evaluation, outcomes: list[EpisodeOutcome]) -> dict[str, Any]:
    return result_of(evaluation.env_id, evaluation.env_kwargs, evaluation.config, outcomes)


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
    config = dict(policy_name=redacted(args.policy), policy_kwargs=policy_kwargs, obs_mode=args.obs_mode)
    return Evaluation(source, env_id, {n: v for n, v in sensing.items() if v is not None} | extra, config)


def _of_checkpoint(checkpoint: Path, kwargs: dict[str, Any], extra: dict[str, Any]) -> Evaluation:
    config = checkpoint_config(checkpoint)
    if missing := [name for name in ("env_id", *SENSING) if name not in config]:
        raise CheckpointError(f"{checkpoint}: its config.json lacks {missing}; train the policy again")
    config |= {name: value for name, value in kwargs.items() if name == "inference_steps" and value}  # what the policy does
    source = PolicySource(checkpoint.resolve(), kwargs=json.dumps(kwargs))  # training may move the link `last` meanwhile
    sensing = {name: config[name] for name in SENSING}
    return Evaluation(source, task_spec(config["env_id"]).env_id, sensing | extra, config)


def run_episodes(
    evaluation: Evaluation,
    seeds: list[int],
    workers: int,
    step_timeout: float,
    on_outcome: Callable[[EpisodeOutcome], None] | None = None,
) -> list[EpisodeOutcome]:
    """Run episodes in worker processes; an episode whose process dies has failed.

    Args:
        evaluation: The policy, and the task.
        seeds: Seeds of the episodes.
        workers: Number of processes.
        step_timeout: Longest time that the policy may take for one action, in s.
        on_outcome: Function that is called with every outcome as soon as the episode ends.

    Returns:
        Outcomes in the order of the seeds.

    Raises:
        PolicyUnavailableError: The policy cannot be asked.
    """
    outcomes: dict[int, EpisodeOutcome] = {}
    secrets = [*secrets_in(evaluation.source.policy), *secrets_in(json.loads(evaluation.source.kwargs))]
    with progress_bar() as bar, WorkerPool(workers, partial(_make_env_and_policy, evaluation)) as pool:
        task = bar.add_task("evaluating", total=len(seeds))
        for seed in seeds:
            pool.submit(partial(_run_seed, step_timeout=step_timeout), seed)
        for finished in pool.as_finished():
            try:
                outcome = finished.result()
            except WorkerDiedError as error:
                reason = f"the policy's process ended with exit code {error.exit_code}: it crashed, or hung for good"
                outcome = EpisodeOutcome(finished.task, False, False, 0, 0.0, 0.0, reason)
            outcome = replace(outcome, error=outcome.error and without_secrets(outcome.error, secrets))
            outcomes[finished.task] = outcome
            if on_outcome is not None:
                on_outcome(outcome)
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
    path = folder / f"{seed}.mp4"
    with atomic_write(path) as partial_path:
        partial_path.write_bytes(encode_video(frames))
    return path


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
