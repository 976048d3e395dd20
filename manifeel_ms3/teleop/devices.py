"""SpaceMouse and gamepad, where one is plugged in: each pushes the operator's axes in a thread of its own."""

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from .operator import Operator

log = logging.getLogger(__name__)
RATE = 200.0  # Hz: a SpaceMouse queues its readings, and what is read too seldom lags
DEAD_ZONE = 0.08  # of full deflection
NO_DEVICE = "no {name} was found: plug one in, or leave out --device; the page's keys and buttons work without"


class DeviceError(RuntimeError):
    """A device that cannot be used."""


@dataclass(frozen=True)
class Reading:
    """Deflections by axis, in [-1, 1], and whether the gripper's button is down."""

    axes: dict[str, float]
    gripper: bool


def spacemouse() -> Iterator[Reading]:
    """Readings of a 3Dconnexion SpaceMouse."""
    try:
        import pyspacemouse  # pyright: ignore
    except ModuleNotFoundError as error:
        raise DeviceError("a SpaceMouse needs pip install 'manifeel-ms3[spacemouse]', and libhidapi") from error
    try:
        mouse = pyspacemouse.open()
    except Exception as error:  # the library raises what hidapi does
        raise DeviceError(NO_DEVICE.format(name="SpaceMouse") + f" ({error})") from error
    while True:
        state = mouse.read()
        turn = dict(roll=state.roll, pitch=state.pitch, yaw=-state.yaw)
        yield Reading(dict(x=state.y, y=-state.x, z=state.z) | turn, bool(any(state.buttons)))


def gamepad() -> Iterator[Reading]:
    """Readings of the first gamepad: left stick x, y; right stick yaw, z; shoulders roll; first button the gripper."""
    try:
        import pygame  # pyright: ignore
    except ModuleNotFoundError as error:
        raise DeviceError("a gamepad needs pip install 'manifeel-ms3[gamepad]'") from error
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # events need a display, and the page is in the browser
    pygame.display.init()
    pygame.joystick.init()
    if pygame.joystick.get_count() == 0:
        raise DeviceError(NO_DEVICE.format(name="gamepad"))
    pad = pygame.joystick.Joystick(0)
    while True:
        pygame.event.pump()
        side, forth, turn, lift = (pad.get_axis(k) for k in (0, 1, 3, 4))
        roll = pad.get_button(5) - pad.get_button(4)
        yield Reading(dict(x=-forth, y=-side, z=-lift, yaw=-turn, roll=float(roll)), bool(pad.get_button(0)))


DEVICES: dict[str, Callable[[], Iterator[Reading]]] = dict(spacemouse=spacemouse, gamepad=gamepad)


def follow(readings: Iterator[Reading], operator: Operator) -> threading.Thread:
    """Let a device push an operator; the first reading is taken at once.

    Raises:
        DeviceError: there is no such device.
    """
    first = next(readings)

    def read() -> None:
        was_down = first.gripper
        for reading in readings:
            for axis, value in reading.axes.items():
                if abs(value) > DEAD_ZONE:
                    operator.push(axis, value)
            if reading.gripper and not was_down:
                operator.toggle_gripper()
            was_down = reading.gripper
            time.sleep(1.0 / RATE)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    return thread
