"""What the person wants: told from any thread, asked by the robot's."""

import threading
import time
from collections.abc import Callable
from enum import Enum

import numpy as np

HOLD = 0.25  # s that a key press moves the arm for; while it is held down, the next one comes before that


class Mode(Enum):
    READY = "ready: start when you like"
    RUNNING = "recording"
    PAUSED = "paused"
    ENDED = "ended: save or discard"
    CLOSED = "closed"


class Wish(Enum):
    """How an episode is to end."""

    STOP = "stop"
    RETRY = "retry"
    SAVE = "save"
    DISCARD = "discard"


class Operator:
    """Motions and wishes of the person who steers.

    Args:
        axes: names of an action's entries, such as ("x", "y", "z", "yaw", "gripper").
        clock: s.
    """

    def __init__(self, axes: tuple[str, ...], clock: Callable[[], float] = time.monotonic):
        self.axes, self.speed, self._clock = axes, 0.5, clock
        self._changed = threading.Condition()
        self._mode, self._wish = Mode.READY, None
        self._pushed: dict[str, tuple[float, float]] = {}
        self._closed_gripper = False

    @property
    def mode(self) -> Mode:
        return self._mode

    def push(self, axis: str, direction: float) -> None:
        """Move along an axis for a moment, in [-1, 1] of the speed; an axis that the task does not have is not moved."""
        with self._changed:
            self._pushed[axis] = (direction, self._clock() + HOLD)

    def toggle_gripper(self) -> None:
        with self._changed:
            self._closed_gripper = not self._closed_gripper

    def action(self) -> np.ndarray:
        """What is wanted now, (A,) in [-1, 1]."""
        with self._changed:
            now = self._clock()
            moving = {axis: direction * self.speed for axis, (direction, until) in self._pushed.items() if now < until}
            moving["gripper"] = -1.0 if self._closed_gripper else 1.0
            return np.clip([moving.get(axis, 0.0) for axis in self.axes], -1.0, 1.0).astype(np.float32)

    # ---------------------------------------------------------------- modes

    def begin(self) -> None:
        """A new episode is there."""
        with self._changed:
            if self._mode is not Mode.CLOSED:
                self._mode = Mode.READY
            self._wish, self._closed_gripper = None, False
            self._pushed.clear()

    def start(self) -> None:
        """Start, or go on."""
        self._move(Mode.RUNNING, Mode.READY, Mode.PAUSED)

    def pause(self) -> None:
        self._move(Mode.PAUSED, Mode.RUNNING)

    def end(self) -> None:
        """The episode is over."""
        self._move(Mode.ENDED, Mode.READY, Mode.RUNNING, Mode.PAUSED)

    def close(self) -> None:
        self._move(Mode.CLOSED, *Mode)

    def wish(self, wish: Wish) -> None:
        with self._changed:
            self._wish = wish
            self._changed.notify_all()

    def may_move(self, patience: float) -> bool:
        """Wait until the robot may move; False after so many s, so that the one who waits can look around."""
        with self._changed:
            return self._changed.wait_for(lambda: self._mode is Mode.RUNNING or self.is_over, patience) and not self.is_over

    def take_wish(self, patience: float) -> Wish | None:
        """A wish that was told, once; None if none came within so many s."""
        with self._changed:
            self._changed.wait_for(lambda: self._wish is not None or self._mode is Mode.CLOSED, patience)
            wish, self._wish = self._wish, None
            return wish

    @property
    def is_over(self) -> bool:
        """Whether the episode is to end."""
        return self._wish is not None or self._mode is Mode.CLOSED

    def _move(self, to: Mode, *of: Mode) -> None:
        with self._changed:
            if self._mode in of:
                self._mode = to
            self._changed.notify_all()
