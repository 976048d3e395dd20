"""Motions and commands of the person who steers: set from any thread, and read by the thread that moves the robot."""

import threading
import time
from collections.abc import Callable
from enum import Enum

import numpy as np

from manifeel_ms3.agents.panda_gelsight import ACTION_AXES, LOCKED_AXES
from manifeel_ms3.errors import InvalidArgumentError

HOLD = 0.25
"""Time in s for which one key press moves the arm; a key that is held down repeats faster, so that the arm keeps moving. Most
systems wait longer than this before the first repeat, so that the arm stops for a moment there; the page's buttons do not."""
OPEN, CLOSED = 1.0, -1.0
"""Gripper commands that open the hand, and that close it as firmly as it can."""
FIRST_SPEED = 0.5
"""Share of the full speed at which the arm moves until the person sets another speed; set once, not tuned."""


class Mode(Enum):
    """State of an episode; the value is the text that the page shows."""

    READY = "ready: press start"
    RUNNING = "recording"
    PAUSED = "paused"
    ENDED = "ended: save or discard"
    CLOSED = "closed"


class EpisodeCommand(Enum):
    """How an episode shall end; the value is the text of the button."""

    STOP = "stop"
    RETRY = "retry"
    SAVE = "save"
    DISCARD = "discard"


def steerable_axes(control_mode: str) -> tuple[str | None, ...]:
    """Names of the entries of an action, for a control mode that a person can steer; None for those that have no effect.

    Raises:
        InvalidArgumentError: Actions of the control mode are not motions of the tool.
    """
    if control_mode not in ACTION_AXES:
        raise InvalidArgumentError(
            f"control_mode={control_mode!r} cannot be steered by hand, because its actions are not motions of the tool; choose "
            f"from {list(ACTION_AXES)}"
        )
    locked = [3 + axis for axis in LOCKED_AXES.get(control_mode, ())]  # rotations come after x, y and z
    return tuple(None if entry in locked else axis for entry, axis in enumerate(ACTION_AXES[control_mode]))


class Operator:
    """Motions and commands of the person who steers.

    Args:
        axes: Names of an action's entries, such as ("x", "y", "z", None, None, "yaw", "gripper"); those without a name stay 0.
        clock: Function that returns the time in s.
    """

    def __init__(self, axes: tuple[str | None, ...], clock: Callable[[], float] = time.monotonic):
        self.axes, self.speed, self._clock = axes, FIRST_SPEED, clock
        self._changed = threading.Condition()
        self._mode = Mode.READY
        self._command: EpisodeCommand | None = None
        self._pushed: dict[str, tuple[float, float]] = {}
        self._gripper, self._closing, self._is_closed = OPEN, CLOSED, False

    @property
    def mode(self) -> Mode:
        """State of the episode."""
        return self._mode

    def push(self, axis: str, direction: float) -> None:
        """Move along an axis for `HOLD` seconds; an axis that the task does not have is ignored.

        Args:
            axis: Name of the axis.
            direction: Velocity in [-1, 1], as a share of the speed that is set.
        """
        with self._changed:
            self._pushed[axis] = (direction, self._clock() + HOLD)

    def toggle_gripper(self) -> None:
        """Open the gripper if it is closed, and close it if it is open."""
        with self._changed:
            self._is_closed = not self._is_closed
            self._gripper = self._closing if self._is_closed else OPEN

    def take_over_gripper(self, command: float, holds_part: bool) -> None:
        """Go on from the gripper's command at the start of an episode.

        Args:
            command: The command, from 1 (open) to -1 (closed).
            holds_part: Whether the hand holds a part with it; it is then also the command that closes the hand again.
        """
        with self._changed:
            self._gripper, self._closing, self._is_closed = command, command if holds_part else CLOSED, holds_part

    def action(self) -> np.ndarray:
        """The action that is wanted now, (A,) in [-1, 1]."""
        with self._changed:
            now = self._clock()
            moving = {axis: direction * self.speed for axis, (direction, until) in self._pushed.items() if now < until}
            moving["gripper"] = self._gripper
            wanted = [moving.get(axis, 0.0) if axis else 0.0 for axis in self.axes]
            return np.clip(wanted, -1.0, 1.0).astype(np.float32)

    # ---------------------------------------------------------------- modes

    def begin(self) -> None:
        """Get ready for a new episode."""
        with self._changed:
            if self._mode is not Mode.CLOSED:
                self._mode = Mode.READY
            self._command = None
            self._pushed.clear()

    def start(self) -> None:
        """Start the episode, or continue it after a pause."""
        self._move(Mode.RUNNING, Mode.READY, Mode.PAUSED)

    def pause(self) -> None:
        """Stop moving until the episode is started again."""
        self._move(Mode.PAUSED, Mode.RUNNING)

    def end(self) -> None:
        """Mark the episode as over."""
        self._move(Mode.ENDED, Mode.READY, Mode.RUNNING, Mode.PAUSED)

    def close(self) -> None:
        """End the session."""
        self._move(Mode.CLOSED, *Mode)

    def command(self, command: EpisodeCommand) -> None:
        """Ask for the end of the episode."""
        with self._changed:
            self._command = command
            self._changed.notify_all()

    def may_move(self, patience: float) -> bool:
        """Wait until the robot may move; False if it may not within `patience` seconds, or if the episode is over."""
        with self._changed:
            return self._changed.wait_for(lambda: self._mode is Mode.RUNNING or self.is_over, patience) and not self.is_over

    def take_command(self, patience: float) -> EpisodeCommand | None:
        """Return the command that was given, and forget it; None if none is given within `patience` seconds."""
        with self._changed:
            self._changed.wait_for(lambda: self._command is not None or self._mode is Mode.CLOSED, patience)
            command, self._command = self._command, None
            return command

    @property
    def is_over(self) -> bool:
        """Whether the episode shall end."""
        return self._command is not None or self._mode is Mode.CLOSED

    def _move(self, to: Mode, *of: Mode) -> None:
        with self._changed:
            if self._mode in of:
                self._mode = to
            self._changed.notify_all()
