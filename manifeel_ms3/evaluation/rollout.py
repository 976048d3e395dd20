"""Roll a policy out, one episode a seed."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from .policy import Policy


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


def evaluate_episode(
    env: gym.Env, policy: Policy, seed: int, on_step: Callable[[dict[str, Any]], None] | None = None
) -> EpisodeOutcome:
    """One episode, ended by success, failure or the time limit; `on_step` sees every observation."""
    obs, _ = env.reset(seed=seed)
    policy.reset()
    once, at_end, peak, thinking, length, over = False, False, 0.0, 0.0, 0, False
    while not over:
        if on_step is not None:
            on_step(obs)
        begin = time.perf_counter()
        action = policy.act(obs)
        thinking += time.perf_counter() - begin
        obs, _, terminated, truncated, info = env.step(np.asarray(action, np.float32))
        length += 1
        at_end = bool(info["success"])
        once |= at_end
        peak = max(peak, float(info["contact_force"]))
        over = bool(terminated) or bool(truncated)
    if on_step is not None:
        on_step(obs)
    return EpisodeOutcome(seed, once, at_end, length, round(peak, 3), round(1e3 * thinking / length, 3))
