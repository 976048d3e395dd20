"""Policies that answer several episodes at once, good and bad; the policy's process imports them by name."""

import os
import signal
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from baselines.registry import policy_spec
from manifeel_ms3.evaluation.policy import PolicyOfPart, PolicyRequest, PolicySource
from tests.evaluation.policies import CannotBeMade as CannotBeMade  # found by its name in this module

FINE, RAISES, CRASHES, HANGS, MISCOUNTS = 10, 20, 30, 40, 50
"""First seeds of ten episodes each, in which the policy behaves in this way."""
KILLED = 60
"""Seed of the episode whose simulating process `KillsASimulation` kills."""


class Part:
    """Asks at every step."""

    def __init__(self, ask):
        self.ask = ask

    def begin_episode(self, seed):
        self.seed, self.step = seed, 0

    def act(self, obs):
        self.step += 1
        return self.ask(PolicyRequest(self.seed, self.step - 1, dict(pose=np.array([self.step]))))


class Moody:
    """Answers with seed, step and the number of requests in the batch; what it does depends on the seed."""

    make_episode_part = Part
    batch_size = 4

    def answer(self, requests):
        seeds = [request.seed // 10 * 10 for request in requests]
        if RAISES in seeds:
            raise RuntimeError("out of ideas")
        if CRASHES in seeds:
            os._exit(7)
        if HANGS in seeds:
            time.sleep(1000)
        time.sleep(0.2)  # so that requests gather
        answers = [np.array([request.seed, request.step, len(requests)]) for request in requests]
        return answers[1:] if MISCOUNTS in seeds else answers


class Single:
    def reset(self):
        pass

    def act(self, obs):
        return np.zeros(6)


class CrashesOnce(Moody):
    """Crashes in an episode of the seed `CRASHES`, and cannot be made again, as where its memory was taken meanwhile."""

    def __init__(self):
        if (marker := Path(os.environ["CRASHES_ONCE"])).exists():
            raise RuntimeError("out of memory")
        marker.touch()


class KillingPart(PolicyOfPart):
    """The part of another policy, which kills its own process at the second step of the episode `KILLED`."""

    def __init__(self, make_part, ask):
        self._part = make_part(ask)

    def begin_episode(self, seed):
        self.seed, self.step = seed, 0
        super().begin_episode(seed)

    def act(self, obs):
        self.step += 1
        if (self.seed, self.step) == (KILLED, 2):
            os.kill(os.getpid(), signal.SIGKILL)
        return super().act(obs)


class KillsASimulation:
    """A checkpoint's policy with another part beside its episodes."""

    def __init__(self, checkpoint: str):
        agent = policy_spec("diffusion_policy").load(Path(checkpoint), batch_size=2)
        self.answer, self.batch_size = agent.answer, agent.batch_size
        self.make_episode_part = partial(KillingPart, agent.make_episode_part)


class DiesWhenMade:
    def __init__(self):
        os._exit(9)


@dataclass(frozen=True)
class SharedSource(PolicySource):
    """A policy of this module, of which one object answers all episodes."""

    @property
    def is_shared(self):
        return True


def source_of(policy: type) -> SharedSource:
    return SharedSource(policy=f"{__name__}:{policy.__name__}")
