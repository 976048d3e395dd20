"""Run a policy for one episode per seed. Every episode has an outcome, whatever the policy does, if it can be reached."""

import faulthandler
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from manifeel_ms3.arguments import checked_action
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.tasks.visuotactile_env import FORCE_DECIMALS

from .policy import Policy, PolicyUnavailableError, with_defaults

HANGS_FOR_GOOD = 10.0
"""Time in s between the time-out and the end of the process, for a policy that hangs in code which no signal interrupts; set
once, not tuned."""
MEAN_DECIMALS, TIME_DECIMALS = 6, 3
"""Decimals of rewards and means in a result, and of times in ms; finer than any comparison needs."""


@dataclass(frozen=True, kw_only=True)
class EpisodeOutcome:
    """Outcome of one episode. Success, failure, return, reward and length are defined as in ManiSkill's `CPUGymWrapper`.

    `data/evaluation_schema.json` describes the same fields in a result file, where `return_` is "return".
    """

    seed: int
    """Seed of the episode, which sets its initial state."""
    success_once: bool = False
    """Whether the task succeeded at any step."""
    success_at_end: bool | None = None
    """Whether the task had succeeded at the last step; None if the episode was stopped at success or failure."""
    fail_once: bool = False
    """Whether the task failed at any step, that is, could not be solved any more."""
    fail_at_end: bool | None = None
    """Whether the task had failed at the last step; None if the episode was stopped at success or failure."""
    success_paper: bool | None = None
    """Whether the threshold of the paper's public code was met at any step (`info["success_paper"]`); None for a task without
    one, and if the episode was stopped at success or failure."""
    first_success: int | None = None
    """Number of control steps until the first success; None without success."""
    return_: float = 0.0
    """Sum of the rewards of all steps."""
    reward: float = 0.0
    """Mean reward of a step."""
    episode_len: int = 0
    """Number of control steps."""
    peak_contact_force: float = 0.0
    """Largest contact force of the episode, in N."""
    force_until_success: float | None = None
    """Largest contact force up to the first success, in N; None without success."""
    inference_ms: float = 0.0
    """Mean time of `Policy.act`, in ms, without the time that it waited for other episodes."""
    ending: str | None = None
    """How the episode ended: "success"; "lost", if the task could not be solved any more; "error"; what was missing at the time
    limit (`VisuotactileEnv.shortcomings`), or "time-out" for a task that does not say; None where nothing was measured."""
    error: str | None = None
    """What the policy did wrong, if anything; the episode then counts as failed."""


ONLY_TO_THE_END = ("success_at_end", "fail_at_end")
"""Fields of an outcome that exist only where episodes run to the time limit."""
NOT_ALWAYS = (*ONLY_TO_THE_END, "success_paper", "ending")
"""Fields of an outcome that result files may lack; earlier files lack the last two."""


def failed_outcome(seed: int, error: str | None, stop_at_success: bool) -> EpisodeOutcome:
    """The outcome of an episode of which nothing could be measured."""
    at_end = None if stop_at_success else False
    ending = "error" if error else None
    return EpisodeOutcome(seed=seed, success_at_end=at_end, fail_at_end=at_end, ending=ending, error=error)


def outcome_as_json(outcome: EpisodeOutcome) -> dict[str, Any]:
    """An outcome as result files hold it; what was not measured has no entry."""
    entries = {name.rstrip("_"): value for name, value in asdict(outcome).items()}
    return {name: value for name, value in entries.items() if value is not None or name not in NOT_ALWAYS}


def outcome_from_json(entries: dict[str, Any]) -> EpisodeOutcome:
    """The outcome that `outcome_as_json` wrote."""
    return EpisodeOutcome(**{"return_" if name == "return" else name: value for name, value in entries.items()})


class PolicyFault(Exception):  # noqa: N818  (a fault of the policy, which the outcome records, and no error of this program)
    """The policy raised an error, returned something that is not an action, or did not answer in time."""


def evaluate_episode(
    env: gym.Env,
    policy: Policy,
    seed: int,
    on_action: Callable[[np.ndarray], None] = lambda _action: None,
    step_timeout: float | None = None,
    stop_at_success: bool = False,
) -> EpisodeOutcome:
    """Run one episode until the time limit of the task, or until a fault of the policy.

    Success and failure do not end it, as in ManiSkill's evaluation (`ignore_terminations=True`).

    Args:
        env: Environment with one episode at a time (`num_envs=1`).
        policy: The policy.
        seed: Seed of the episode.
        on_action: Function that is called with every action (A,) before it is done.
        step_timeout: Longest time that the policy may take for one action, in s; no limit if not given, or if the policy's
            attribute `limits_itself` is true (`EpisodePolicy`). A limit works only in the main thread of a process.
        stop_at_success: End the episode at success or failure.

    Raises:
        PolicyUnavailableError: The policy cannot be reached, so that the episode has no outcome.
    """
    obs, _ = env.reset(seed=seed)
    task: Any = env.unwrapped
    shape = task.single_action_space.shape
    metrics, over, fault = _Metrics(seed), False, None
    whole = with_defaults(policy)
    step_timeout = None if whole.limits_itself else step_timeout
    try:
        _answer(lambda: whole.begin_episode(seed), step_timeout)
        while not over:
            begin = time.perf_counter()
            action = _checked(_answer(lambda obs=obs: whole.act(obs), step_timeout), shape)
            looks, waited = _answer(lambda: (bool(whole.looks), float(whole.waited)), step_timeout)
            metrics.thinking += time.perf_counter() - begin - waited
            task.renders_cameras = looks
            on_action(action)
            obs, reward, terminated, truncated, info = env.step(action)
            metrics.add(float(reward), info)
            over = bool(truncated) or (stop_at_success and bool(terminated))
    except PolicyFault as error:
        fault = f"step {metrics.steps}: {error}"
    finally:
        task.renders_cameras = True
    return metrics.outcome(not stop_at_success, fault, shortcoming=_shortcoming(task, metrics))


@dataclass
class _Metrics:
    """What is measured while an episode runs."""

    seed: int
    steps: int = 0
    thinking: float = 0.0
    """Time in s that the policy took."""
    returned: float = 0.0
    """Sum of the rewards."""
    peak: float = 0.0
    """Largest contact force, in N."""
    force_until_success: float | None = None
    first_success: int | None = None
    success: bool = False
    """Whether the task has succeeded at the last step."""
    fail: bool = False
    """Whether the task has failed at the last step."""
    fail_once: bool = False
    last: dict[str, Any] = field(default_factory=dict)
    """The info of the last step."""

    def add(self, reward: float, info: dict[str, Any]) -> None:
        """Add a step.

        Raises:
            PolicyFault: The contact force is NaN or infinite: the actions have made the simulation diverge.
        """
        self.steps += 1
        self.last = info
        force = float(info["contact_force"])
        if not math.isfinite(force) or not math.isfinite(reward):
            raise PolicyFault(f"the simulation has diverged: the contact force is {force}, the reward {reward}")
        self.returned += reward
        self.peak = max(self.peak, force)
        self.success, self.fail = bool(info["success"]), bool(info["fail"])
        self.fail_once |= self.fail
        if self.success and self.first_success is None:
            self.first_success, self.force_until_success = self.steps, round(self.peak, FORCE_DECIMALS)

    def outcome(self, to_the_end: bool, error: str | None, shortcoming: str) -> EpisodeOutcome:
        """The outcome; with an error the episode has failed, whatever was reached before.

        Args:
            to_the_end: Whether success and failure did not end the episode.
            error: What the policy did wrong, if anything.
            shortcoming: What is missing if the episode neither succeeded nor was lost.
        """
        won = error is None and self.first_success is not None
        by_paper = self.last.get("success_paper") if to_the_end else None
        ending = "error" if error else "success" if won else "lost" if self.fail_once else shortcoming
        return EpisodeOutcome(
            seed=self.seed,
            success_once=won,
            success_at_end=won and self.success if to_the_end else None,
            fail_once=self.fail_once,
            fail_at_end=self.fail if to_the_end else None,
            success_paper=None if by_paper is None else error is None and bool(by_paper),
            first_success=self.first_success if won else None,
            return_=round(self.returned, MEAN_DECIMALS),
            reward=round(self.returned / max(self.steps, 1), MEAN_DECIMALS),
            episode_len=self.steps,
            peak_contact_force=round(self.peak, FORCE_DECIMALS),
            force_until_success=self.force_until_success if won else None,
            inference_ms=round(max(1e3 * self.thinking, 0.0) / max(self.steps, 1), TIME_DECIMALS),
            ending=ending,
            error=error,
        )


def _shortcoming(task: Any, metrics: _Metrics) -> str:
    """What is missing at the end of an episode without success, by the rule of `EpisodeOutcome.ending`."""
    missing = task.shortcomings(metrics.last) if metrics.steps and hasattr(task, "shortcomings") else {}
    return next((name for name, holds in missing.items() if bool(holds)), "time-out")


def _answer(ask: Callable[[], Any], step_timeout: float | None) -> Any:
    """The return value of one of the policy's methods.

    Raises:
        PolicyFault: The method raised an error, or took too long.
        PolicyUnavailableError: The policy cannot be reached.
    """
    try:
        with _time_limit(step_timeout):
            return ask()
    except (PolicyFault, PolicyUnavailableError):
        raise
    except (Exception, SystemExit) as error:  # a policy may raise anything
        raise PolicyFault(f"{type(error).__name__}: {error}") from error


def _checked(action: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return the policy's action as an array of the task's shape.

    It may have a leading dimension of 1, as a batch of one environment.

    Raises:
        PolicyFault: The task does not take the action.
    """
    try:
        return checked_action(action, (shape, (1, *shape))).numpy().reshape(shape)
    except InvalidArgumentError as error:
        raise PolicyFault(str(error)) from error


@contextmanager
def _time_limit(seconds: float | None) -> Iterator[None]:
    """Raise a PolicyFault after a number of seconds; code that cannot be interrupted ends the process a little later."""
    if seconds is None:
        yield
        return

    def stop(*_):
        raise PolicyFault(f"no answer within {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    faulthandler.dump_traceback_later(seconds + HANGS_FOR_GOOD, exit=True)
    try:
        yield
    finally:  # each step in a finally of its own, since the alarm may still come before the first has been done
        try:
            signal.setitimer(signal.ITIMER_REAL, 0)
        finally:
            signal.signal(signal.SIGALRM, before)
            faulthandler.cancel_dump_traceback_later()
