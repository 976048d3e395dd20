"""Episodes that a person steers, one after the other; each is saved when the person asks for it."""

import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol, cast

import gymnasium as gym
import numpy as np

from manifeel_ms3.agents.panda_gelsight import GRASP_FORCE
from manifeel_ms3.demonstrations.episode import run_episode
from manifeel_ms3.demonstrations.formats.maniskill_h5_writing import RecordedEpisode, write_episode
from manifeel_ms3.demonstrations.recording import make_header, open_recording, require_demonstration_seeds
from manifeel_ms3.experts.skills import Skills
from manifeel_ms3.tasks import VisuotactileEnv

from .operator import EpisodeCommand, Mode, Operator

log = logging.getLogger(__name__)
PATIENCE = 0.2
"""Time in s between two checks of the mode while the robot does not move; short enough for a person not to notice."""
SOURCE = dict(source_type="human", source_desc="a person at the teleoperation page")
"""Origin of the episodes, in the json of the trajectory file."""


class Screen(Protocol):
    """Where the person sees an episode."""

    def show(self, obs: dict[str, Any], info: dict[str, Any]) -> None:
        """Show an observation and its `info`."""
        ...

    def set_message(self, text: str) -> None:
        """Show a line of text."""
        ...


class Session:
    """Episodes with rising seeds, recorded into one trajectory file, which the session holds until `finish` is called.

    Args:
        env: Environment with `num_envs=1`.
        env_id: Id of its task.
        env_kwargs: Arguments that it was made with.
        out: Path of the trajectory file; episodes that it holds already are kept.
        seed: Seed of the first episode; the seed after the largest one in the file if that is larger.
        operator: Motions and commands of the person.

    Raises:
        InvalidArgumentError: The seed is not one of those for demonstrations.
        DemonstrationError: The file was recorded with other arguments.
        InUseError: Another process records into the file.
    """

    def __init__(self, env: gym.Env, env_id: str, env_kwargs: dict[str, Any], out: Path, seed: int, operator: Operator):
        require_demonstration_seeds(seed, 1, f"--seed {seed}: ")
        self.env, self.out, self.operator = env, out, operator
        base: Any = env.unwrapped
        self._period = 1.0 / base.control_freq
        header = make_header(env_id, env_kwargs) | SOURCE | dict(failed_seeds=[])
        with ExitStack() as stack:
            self._recording = stack.enter_context(open_recording(out, header))
            self._recording.begin()
            for kept in list(self._recording.kept):  # its session was killed before the episode entered the file
                self._recording.accept_kept(kept)
            self._held = stack.pop_all()
        self._seed = max([seed, *(saved + 1 for saved in self._recording.infos)])
        if self._seed != seed:
            log.info("%s holds episodes up to the seed %d; the next has the seed %d", out, self._seed - 1, self._seed)

    def run(self, screen: Screen) -> None:
        """Run episodes until the operator ends the session.

        Raises:
            InvalidArgumentError: The seeds for demonstrations are used up.
        """
        while self.operator.mode is not Mode.CLOSED:
            require_demonstration_seeds(self._seed, 1, f"the next episode would have the seed {self._seed}; ")
            self.operator.begin()
            screen.set_message(f"seed {self._seed}, {self.num_saved} saved")
            episode = run_episode(self.env, self._seed, self._actions, screen.show)
            command = self._decision(screen, episode)
            if command is not EpisodeCommand.RETRY:
                self._seed += 1

    @property
    def num_saved(self) -> int:
        """Number of episodes in the file."""
        return len(self._recording.infos)

    def finish(self) -> None:
        """Turn the saved episodes into one file, and let others record into it."""
        with self._held:
            self._recording.finish()

    def _actions(self) -> Iterator[np.ndarray]:
        """Actions at the environment's control rate, while the operator lets the robot move; the first ones keep the grip.

        A grip on a thin part becomes weaker (`Skills.present_grip`).
        """
        if "gripper" in self.operator.axes:
            skills = Skills(cast(VisuotactileEnv, self.env.unwrapped))
            self.operator.take_over_gripper(skills.present_grip, bool(skills.squeeze.min() >= GRASP_FORCE))
        due = time.monotonic()
        while not self.operator.is_over:
            if not self.operator.may_move(PATIENCE):
                continue
            now = time.monotonic()
            if now > due + self._period:  # after a pause, or where a step takes longer than a period
                due = now
            time.sleep(max(due - now, 0.0))
            due += self._period
            yield self.operator.action()

    def _decision(self, screen: Screen, episode: RecordedEpisode) -> EpisodeCommand | None:
        """Wait for the command that saves, discards or repeats an episode that is over; None if the session ends before it."""
        command = self.operator.take_command(0.0)
        self.operator.end()
        result, refused = "success" if episode.info["success"] else "no success", False
        while self.operator.mode is not Mode.CLOSED:
            if command in (EpisodeCommand.RETRY, EpisodeCommand.DISCARD):
                return command
            if episode.info["elapsed_steps"] == 0:
                return EpisodeCommand.RETRY  # there is nothing to save
            if command is EpisodeCommand.SAVE:
                if self._save(screen, episode):
                    return command
                refused = True  # the screen keeps the reason
            elif not refused:
                screen.set_message(f"seed {self._seed}: {result} after {episode.info['elapsed_steps']} steps; save or discard")
            command = self.operator.take_command(PATIENCE)
        return None

    def _save(self, screen: Screen, episode: RecordedEpisode) -> bool:
        """Write an episode, and return whether that worked; if it did not, the page shows the reason."""
        try:
            write_episode(self._recording.drafts, episode)
            self._recording.accept(episode.seed, episode.info)
        except OSError as error:
            screen.set_message(f"the episode could not be saved ({error}); make room, then save again: it is still here")
            return False
        return True
