"""State of an episode whose policy predicts several actions at once: past observations, and actions still to execute."""

from collections import deque
from typing import Any

import numpy as np
from mani_skill.utils import common

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation.policy import Ask, EpisodePolicy, PolicyRequest

from .observation import POSE, ObservationSpec, prepare
from .pose_targets import POSITION, Command, rotations_of


class ActionChunks(EpisodePolicy):
    """Executes the actions of a prediction one by one, then asks for the next from the last `obs_horizon` observations.

    This module imports no network, so that a process that simulates starts quickly.

    Args:
        spec: Observations of the policy.
        obs_horizon: Number of observations that condition a prediction.
        ask: Function that returns the actions (n, A) of a prediction.
        limit: Largest size of a component of an action; infinite for controllers that take joint angles or poses.
        targets_of: Control mode whose actions reach the targets (`pose_targets`) that are predicted; None if actions are.
    """

    def __init__(self, spec: ObservationSpec, obs_horizon: int, ask: Ask, limit: float = 1.0, targets_of: str | None = None):
        self.spec, self.obs_horizon, self._ask, self._limit = spec, obs_horizon, ask, limit
        self._targets_of = targets_of
        self.reset()

    @property
    def looks(self) -> bool:
        """Whether the next observation is part of a prediction."""
        return len(self._actions) < self.obs_horizon

    def reset(self) -> None:
        """Begin an episode with the seed 0."""
        self.begin_episode(0)

    def begin_episode(self, seed: int) -> None:
        """Begin the episode of a seed."""
        self._seed, self._step = seed, 0
        self._window: deque[dict[str, np.ndarray]] = deque(maxlen=self.obs_horizon)
        self._actions: deque[np.ndarray] = deque()
        self._command: Command | None = None

    def act(self, obs: dict[str, Any]) -> np.ndarray:
        """The action (A,) for the observation of an environment with `num_envs=1`."""
        if self.looks:
            self._window.append(self._prepared(obs))
        if not self._actions:
            window = [self._window[0]] * (self.obs_horizon - len(self._window)) + list(self._window)
            observation = {key: np.stack([step[key] for step in window]) for key in window[0]}
            self._actions.extend(self._ask(PolicyRequest(self._seed, self._step, observation)))
            self._seen_from = observation[POSE][-1, POSITION]
        self._step += 1
        action = self._actions.popleft()
        if self._targets_of is None:
            return action.clip(-self._limit, self._limit)
        return self._action_to(action, obs, self._targets_of)

    def _action_to(self, target: np.ndarray, obs: dict[str, Any], control_mode: str) -> np.ndarray:
        """The action that leads to a target (A,), whose position is relative to where the tool was at the prediction."""
        pose = self._prepared_one(POSE, obs)
        tool = pose[POSITION].astype(float), rotations_of(pose[None])[0]
        self._command = self._command or Command(*tool, control_mode)
        self._command.follow(*tool)
        target = target.astype(float)
        target[POSITION] += self._seen_from
        action = self._command.action_to(target)
        self._command.move(action)
        return action

    def _prepared(self, obs: dict[str, Any]) -> dict[str, np.ndarray]:
        return {key: self._prepared_one(key, obs) for key in self.spec.keys}

    def _prepared_one(self, key: str, obs: dict[str, Any]) -> np.ndarray:
        value: Any = obs
        for part in key.split("/"):
            value = value[part]
        prepared = prepare(key, common.to_numpy(value), self.spec)[0]
        if key in self.spec.force_fields and prepared.shape[:2] != self.spec.taxel_shape:
            raise InvalidArgumentError(
                f"{key} has {prepared.shape[:2]} rows and columns of taxels, but the policy learnt from "
                f"{self.spec.taxel_shape}; evaluate it with the sensor of its demonstrations"
            )
        return prepared
