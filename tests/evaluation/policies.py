"""Policies of someone's own, good and bad; evaluation imports them by name."""

import os
import time

import numpy as np


class StandStill:
    def __init__(self, size: int = 6):
        self.size = size

    def reset(self):
        self.steps = 0

    def act(self, obs):
        self.steps += 1
        return np.zeros(self.size)


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


class CannotBeMade(StandStill):
    def __init__(self):
        raise OSError("no weights")
