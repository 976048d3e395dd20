"""Run a policy for one episode per seed. Whatever the policy does, there is an outcome, unless it cannot be asked at all."""

import faulthandler
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from manifeel_ms3.arguments import checked_action
from manifeel_ms3.errors import InvalidArgumentError

from .policy import Policy, PolicyUnavailableError

HANGS_FOR_GOOD = 10.0
"""Time in s between the time-out and the end of the process, for a policy that hangs in code which no signal interrupts."""


@dataclass
class EpisodeOutcome:
    """Outcome of one episode."""

    seed: int
    """Seed of the episode, which sets its initial state."""
    success_once: bool
    """Whether the task succeeded at any step."""
    success_at_end: bool
    """Whether the task had succeeded at the last step."""
    length: int
    """Number of control steps."""
    peak_contact_force: float
    """Largest contact force of the episode, in N."""
    inference_ms: float
    """Mean time of `Policy.act`, in ms."""
    error: str | None = None
    """What the policy did wrong, if anything; the episode then counts as failed."""


class PolicyFault(Exception):  # noqa: N818  (a fault of the policy, which the outcome records, and no error of this program)
    """The policy raised an error, returned something that is not an action, or did not answer in time."""


def evaluate_episode(
    env: gym.Env,
    policy: Policy,
    seed: int,
    on_step: Callable[[dict[str, Any]], None] | None = None,
    step_timeout: float | None = None,
) -> EpisodeOutcome:
    """Run one episode until success, failure, the time limit of the task, or a fault of the policy.

    Args:
        env: Environment with one episode at a time (`num_envs=1`).
        policy: The policy.
        seed: Seed of the episode.
        on_step: Function that is called with every observation, the last one included.
        step_timeout: Longest time that the policy may take for one action, in s; no limit if not given. A limit works only
            in the main thread of a process.

    Raises:
        PolicyUnavailableError: The policy cannot be asked, so that the episode has no outcome.
    """
    obs, _ = env.reset(seed=seed)
    task: Any = env.unwrapped
    shape = task.single_action_space.shape
    once, at_end, peak, thinking, length, over, fault = False, False, 0.0, 0.0, 0, False, None
    try:
        _answer(policy.reset, step_timeout)
        while not over:
            if on_step is not None:
                on_step(obs)
            begin = time.perf_counter()
            action = _checked(_answer(lambda obs=obs: policy.act(obs), step_timeout), shape)
            thinking += time.perf_counter() - begin
            obs, _, terminated, truncated, info = env.step(action)
            length += 1
            at_end = bool(info["success"])
            once |= at_end
            peak = max(peak, _finite_force(info))
            over = bool(terminated) or bool(truncated)
    except PolicyFault as error:
        once, at_end, fault = False, False, f"step {length}: {error}"
    if on_step is not None:
        on_step(obs)
    mean = 1e3 * thinking / max(length, 1)
    return EpisodeOutcome(seed, once, at_end, length, round(peak, 3), round(mean, 3), fault)


def _finite_force(info: dict[str, Any]) -> float:
    """The contact force of a step, in N.

    Raises:
        PolicyFault: It is NaN or infinite: the actions have made the simulation diverge.
    """
    force = float(info["contact_force"])
    if not math.isfinite(force):
        raise PolicyFault(f"the simulation has diverged: the contact force is {force}")
    return force


def _answer(ask: Callable[[], Any], step_timeout: float | None) -> Any:
    """The return value of one of the policy's methods.

    Raises:
        PolicyFault: The method raised an error, or took too long.
        PolicyUnavailableError: The policy cannot be asked.
    """
    try:
        with _time_limit(step_timeout):
            return ask()
    except (PolicyFault, PolicyUnavailableError):
        raise
    except Exception as error:  # a policy is anybody's code
        raise PolicyFault(f"{type(error).__name__}: {error}") from error


def _checked(action: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return the policy's action as an array.

    Raises:
        PolicyFault: The task does not take it.
    """
    try:
        return checked_action(action, (shape,)).numpy()
    except InvalidArgumentError as error:
        raise PolicyFault(str(error)) from error


@contextmanager
def _time_limit(seconds: float | None) -> Iterator[None]:
    """Raise a PolicyFault after so many seconds; code that cannot be interrupted ends the process a little later."""
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
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        faulthandler.cancel_dump_traceback_later()
