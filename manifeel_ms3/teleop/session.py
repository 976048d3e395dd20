"""Episodes that a person steers: one after the other, kept when the person says so."""

import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from manifeel_ms3.demonstrations.episode import run_episode
from manifeel_ms3.demonstrations.formats.maniskill_h5 import (
    Episode,
    consolidate,
    episode_folder,
    split,
    write_episode,
    write_index,
)
from manifeel_ms3.demonstrations.record import already_there, make_header

from .operator import Mode, Operator, Wish

log = logging.getLogger(__name__)
PATIENCE = 0.2  # s between looks at the mode while nothing moves
SOURCE = dict(source_type="human", source_desc="a person at the teleoperation page")


class Screen(Protocol):
    """Where an episode is shown."""

    def show(self, obs: dict[str, Any], info: dict[str, Any]) -> None:
        """What is seen now."""
        ...

    def tell(self, text: str) -> None:
        """A line for the person."""
        ...


class Session:
    """Episodes with rising seeds, recorded into one trajectory file.

    Args:
        out: trajectory file; what is in it stays.

    Raises:
        DemonstrationError: the file was recorded with other settings.
    """

    def __init__(self, env: gym.Env, env_id: str, env_kwargs: dict[str, Any], out: Path, seed: int, operator: Operator):
        self.env, self.out, self.operator = env, out, operator
        self._header = make_header(env_id, env_kwargs) | SOURCE
        self._infos, self._failed = already_there(out, self._header)
        self._seed = max([seed, *(saved + 1 for saved in self._infos)])
        self._period = 1.0 / env.unwrapped.control_freq
        out.parent.mkdir(parents=True, exist_ok=True)
        if out.is_file() and not episode_folder(out).is_dir():
            split(out)

    def run(self, screen: Screen) -> None:
        """Until the operator closes."""
        while self.operator.mode is not Mode.CLOSED:
            self.operator.begin()
            screen.tell(f"seed {self._seed}, {len(self._infos)} saved")
            episode = run_episode(self.env, self._seed, self._actions, screen.show)
            wish = self._decision(screen, episode)
            if wish is not Wish.RETRY:
                self._seed += 1

    def finish(self) -> None:
        """Make one file of what was saved."""
        if self.out.is_file():
            consolidate(self.out)

    def _actions(self) -> Iterator[np.ndarray]:
        """At the environment's control rate, while the operator lets the robot move."""
        due = time.monotonic()
        while not self.operator.is_over:
            if not self.operator.may_move(PATIENCE):
                continue
            now = time.monotonic()
            if now > due + self._period:  # it was paused, or is too slow
                due = now
            time.sleep(max(due - now, 0.0))
            due += self._period
            yield self.operator.action()

    def _decision(self, screen: Screen, episode: Episode) -> Wish | None:
        """What is to become of an episode that is over; it is kept until that is done."""
        wish = self.operator.take_wish(0.0)
        self.operator.end()
        result = "success" if episode.info["success"] else "no success"
        while self.operator.mode is not Mode.CLOSED:
            if wish in (Wish.RETRY, Wish.DISCARD):
                return wish
            if episode.info["elapsed_steps"] == 0:
                return Wish.RETRY  # there is nothing to save
            if wish is Wish.SAVE and self._saved(screen, episode):
                return wish
            if wish is None or wish is Wish.STOP:
                screen.tell(f"seed {self._seed}: {result} after {episode.info['elapsed_steps']} steps; save or discard")
            wish = self.operator.take_wish(PATIENCE)
        return None

    def _saved(self, screen: Screen, episode: Episode) -> bool:
        """Write it; where that does not work, say why, and keep it."""
        try:
            write_episode(self.out, episode)
            infos = self._infos | {episode.seed: episode.info | dict(episode_seed=episode.seed)}
            write_index(self.out, self._header | dict(failed_seeds=sorted(self._failed)), dict(sorted(infos.items())))
        except OSError as error:
            screen.tell(f"it could not be saved ({error}); make room, then save again: the episode is still here")
            return False
        self._infos = infos
        return True
