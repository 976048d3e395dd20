"""Roll a policy out, one episode a seed; whatever the policy does, there is an outcome."""

import faulthandler
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

from .policy import Policy

HANGS_FOR_GOOD = 10.0  # s after the time-out, until a policy that does not even notice it takes its process down


@dataclass
class EpisodeOutcome:
    """How an episode went."""

    seed: int
    success_once: bool
    success_at_end: bool
    length: int
    """steps"""
    peak_contact_force: float
    """N"""
    inference_ms: float
    """mean time of `act`"""
    error: str | None = None
    """what the policy did wrong; the episode then counts as failed"""


class PolicyFault(Exception):
    """The policy raised, answered nonsense, or did not answer."""


def evaluate_episode(
    env: gym.Env,
    policy: Policy,
    seed: int,
    on_step: Callable[[dict[str, Any]], None] | None = None,
    step_timeout: float | None = None,
) -> EpisodeOutcome:
    """One episode, ended by success, failure, the time limit or a fault of the policy; `on_step` sees every observation.

    Args:
        step_timeout: s that a policy may take for an action; None: as long as it likes. Needs the process's main thread.
    """
    obs, _ = env.reset(seed=seed)
    shape = env.unwrapped.single_action_space.shape
    once, at_end, peak, thinking, length, over, fault = False, False, 0.0, 0.0, 0, False, None
    try:
        _answer(policy.reset, step_timeout)
        while not over:
            if on_step is not None:
                on_step(obs)
            begin = time.perf_counter()
            action = _checked(_answer(lambda seen=obs: policy.act(seen), step_timeout), shape)
            thinking += time.perf_counter() - begin
            obs, _, terminated, truncated, info = env.step(action)
            length += 1
            at_end = bool(info["success"])
            once |= at_end
            peak = max(peak, float(info["contact_force"]))
            over = bool(terminated) or bool(truncated)
    except PolicyFault as error:
        once, at_end, fault = False, False, f"step {length}: {error}"
    if on_step is not None:
        on_step(obs)
    mean = 1e3 * thinking / max(length, 1)
    return EpisodeOutcome(seed, once, at_end, length, round(peak, 3), round(mean, 3), fault)


def _answer(ask: Callable[[], Any], step_timeout: float | None) -> Any:
    """What the policy answers.

    Raises:
        PolicyFault: it raised, or took too long.
    """
    try:
        with _time_limit(step_timeout):
            return ask()
    except PolicyFault:
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
    """Raise PolicyFault after so many seconds; what cannot be interrupted, ends the process a little later."""
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
