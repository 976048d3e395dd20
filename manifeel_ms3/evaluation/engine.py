"""Run episodes in worker processes, with one process that holds the policy."""

import json
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import gymnasium as gym

from manifeel_ms3.progress import progress_bar
from manifeel_ms3.tasks.registry import make_env
from manifeel_ms3.workers import WorkerDiedError, WorkerPool

from .policy import STEP_TIMEOUT, Policy, PolicySource
from .policy_process import PolicyProcess, SharedPolicy
from .redaction import secrets_in, without_secrets
from .rollout import EpisodeOutcome, evaluate_episode, failed_outcome


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
    stop_at_success: bool = False
    """Whether episodes end at success or failure instead of at the time limit."""
    step_timeout: float = STEP_TIMEOUT
    """Longest time that the policy may take for one action, in s."""


def run_episodes(
    evaluation: Evaluation,
    seeds: list[int],
    workers: int,
    on_outcome: Callable[[EpisodeOutcome], None] | None = None,
) -> list[EpisodeOutcome]:
    """Run episodes in worker processes; an episode whose process dies has failed.

    A policy that can answer several episodes at once runs in one additional process; any other policy runs in each worker. The
    number of workers changes no outcome.

    Args:
        evaluation: The policy, and the task.
        seeds: Seeds of the episodes.
        workers: Number of processes that simulate.
        on_outcome: Function that is called with every outcome as soon as the episode ends.

    Returns:
        Outcomes in the order of the seeds.

    Raises:
        PolicyUnavailableError: The policy cannot be reached.
        Exception: The error that making the environment or the policy raises.
    """
    if not seeds:
        return []
    source = evaluation.source
    shared = PolicyProcess(source, evaluation.step_timeout) if source.is_shared else nullcontext()
    outcomes: dict[int, EpisodeOutcome] = {}
    with progress_bar() as bar, shared as policy:
        task = bar.add_task("evaluating", total=len(seeds))
        for outcome in _outcomes(evaluation, seeds, min(workers, len(seeds)), policy and policy.address):
            outcomes[outcome.seed] = outcome
            if on_outcome is not None:
                on_outcome(outcome)
            successes = sum(outcome.success_once for outcome in outcomes.values())
            bar.update(task, advance=1, description=f"evaluating, {successes} of {len(outcomes)} succeed")
    return [outcomes[seed] for seed in seeds]


def _outcomes(evaluation: Evaluation, seeds: list[int], workers: int, address: str | None) -> Iterator[EpisodeOutcome]:
    """The outcome of each episode as soon as it ends."""
    source = evaluation.source
    secrets = [*secrets_in(source.policy), *secrets_in(json.loads(source.kwargs))]
    with WorkerPool(workers, partial(_make_env_and_policy, evaluation, address)) as pool:
        for seed in seeds:
            pool.submit(partial(_run_seed, evaluation), seed)
        for finished in pool.as_finished():
            try:
                outcome = finished.result()
            except WorkerDiedError as error:
                outcome = failed_outcome(finished.task, _reason(error, evaluation), evaluation.stop_at_success)
            yield replace(outcome, error=outcome.error and without_secrets(outcome.error, secrets))


def _reason(error: WorkerDiedError, evaluation: Evaluation) -> str:
    who = "simulating" if evaluation.source.is_shared else "policy's"
    return f"the {who} process ended with exit code {error.exit_code}: it crashed, or hung for good"


# -------------------------------------------------------------------- in a worker process


def _make_env_and_policy(evaluation: Evaluation, address: str | None) -> tuple[gym.Env, Policy]:
    """The environment and the policy, which a worker keeps from one episode to the next."""
    env = make_env(evaluation.env_id, **evaluation.env_kwargs)
    make = evaluation.source.make
    return env, make() if address is None else SharedPolicy(address, make)


def _run_seed(evaluation: Evaluation, env_and_policy: tuple[gym.Env, Policy], seed: int) -> EpisodeOutcome:
    env, policy = env_and_policy
    return evaluate_episode(env, policy, seed, step_timeout=evaluation.step_timeout, stop_at_success=evaluation.stop_at_success)
