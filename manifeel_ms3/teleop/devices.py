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
SIX_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
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
        mouse = pyspacemouse.open(axis_convention="ros")  # x ahead, y left, z up, as the robot's base; right-handed turns
    except Exception as error:  # the library raises what hidapi does
        raise DeviceError(NO_DEVICE.format(name="SpaceMouse") + f" ({error})") from error
    while True:
        state = mouse.read()
        yield Reading({axis: getattr(state, axis) for axis in SIX_AXES}, any(state.buttons))


def gamepad() -> Iterator[Reading]:
    """Readings of the first gamepad: left stick x, y; right stick yaw, z; shoulders roll; lowest button the gripper.

    By SDL's names of sticks and buttons, whose numbers are others from pad to pad and from system to system.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # events need a display, and the page is in the browser
    try:
        import pygame  # pyright: ignore
        from pygame._sdl2 import controller  # pyright: ignore
    except ModuleNotFoundError as error:
        raise DeviceError("a gamepad needs pip install 'manifeel-ms3[gamepad]'") from error
    pygame.display.init()
    controller.init()
    found = [k for k in range(controller.get_count()) if controller.is_controller(k)]
    if not found:
        raise DeviceError(NO_DEVICE.format(name="gamepad"))
    pad = controller.Controller(found[0])

    def stick(name: str) -> float:
        return pad.get_axis(getattr(pygame, f"CONTROLLER_AXIS_{name}")) / 32767

    while True:
        pygame.event.pump()
        roll = pad.get_button(pygame.CONTROLLER_BUTTON_RIGHTSHOULDER) - pad.get_button(pygame.CONTROLLER_BUTTON_LEFTSHOULDER)
        axes = dict(x=-stick("LEFTY"), y=-stick("LEFTX"), z=-stick("RIGHTY"), yaw=-stick("RIGHTX"), roll=float(roll))
        yield Reading(axes, bool(pad.get_button(pygame.CONTROLLER_BUTTON_A)))


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
