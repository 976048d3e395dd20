"""Policies of a user's own, good and bad, which evaluation imports by name."""

import hashlib
import os
import sys
import time

import numpy as np

from manifeel_ms3.evaluation.policy import PolicyUnavailableError

STUCK = "MANIFEEL_TEST_STUCK"
"""Environment variable that makes `SticksInSecondEpisode` stick."""


class StandStill:
    def __init__(self, size: int = 6):
        self.size = size

    def reset(self):
        self.steps = 0

    def act(self, obs):
        self.steps += 1
        return np.zeros(self.size)


class LetsGo(StandStill):
    """Opens the gripper, which is the last component of an action of seven."""

    def act(self, obs):
        return np.append(np.zeros(6), 1.0)


class Raises(StandStill):
    def act(self, obs):
        raise RuntimeError("out of ideas")


class SaysNaN(StandStill):
    def act(self, obs):
        return np.full(6, np.nan) if self.steps == 3 else super().act(obs)


class SaysWords(StandStill):
    def act(self, obs):
        return "left"


class Sleeps(StandStill):
    def act(self, obs):
        time.sleep(30)


class Crashes(StandStill):
    def reset(self):
        super().reset()
        os._exit(7)


class Leaves(StandStill):
    """Ends its process as if all were well."""

    def act(self, obs):
        os._exit(0)


class Exits(StandStill):
    """Calls `sys.exit`, as a script does at its end."""

    def act(self, obs):
        sys.exit(0)


class CannotBeMade(StandStill):
    def __init__(self):
        raise OSError("no weights")


class SticksInSecondEpisode(StandStill):
    """If the environment variable is set, it computes for minutes in native code, where no signal handler of Python runs."""

    episodes = 0

    def reset(self):
        super().reset()
        self.episodes += 1

    def act(self, obs):
        if os.environ.get(STUCK) and self.episodes > 1:
            hashlib.pbkdf2_hmac("sha1", b"", b"", 2**31 - 1)
        return super().act(obs)


class LeaksAndGoesAway(StandStill):
    """Its first episode fails with a message that holds its key; then it cannot be reached."""

    episodes = 0

    def __init__(self, api_key: str, options: dict):
        super().__init__()
        self.api_key = api_key

    def reset(self):
        self.episodes += 1
        if self.episodes > 1:
            raise PolicyUnavailableError("gone")
        raise RuntimeError(f"{self.api_key} is refused")


class FollowsAllItSees:
    """Actions that follow from every number of the observation, so that any other observation gives other actions."""

    def reset(self):
        pass

    def act(self, obs):
        seen = np.concatenate([np.ravel(array).astype(float) for array in _arrays(obs)])
        return np.sin(seen.sum() + np.arange(6))


def _arrays(obs):
    return [array for part in obs.values() for array in _arrays(part)] if isinstance(obs, dict) else [np.asarray(obs)]
