"""SpaceMouse and gamepad: each pushes the axes of the operator from a thread of its own."""

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from manifeel_ms3.errors import MachineError

from .operator import Operator

log = logging.getLogger(__name__)
RATE = 200.0
"""Rate in Hz at which a device is read. A SpaceMouse queues its readings, so that motions lag if it is read too slowly."""
DEAD_ZONE = 0.08
"""Share of the full deflection below which an axis counts as released: sticks at rest do not read exactly 0. Set
once, not tuned."""
STICK_RANGE = 32767
"""Reading of a gamepad's stick at full deflection: SDL gives int16."""
SIX_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Names of the axes of a SpaceMouse."""
NO_DEVICE = "no {name} was found: plug one in, or leave out --device; the page's keys and buttons work without a device"


class DeviceError(MachineError):
    """A device cannot be used."""


@dataclass(frozen=True)
class Reading:
    """State of a device at one moment."""

    axes: dict[str, float]
    """Deflections in [-1, 1] by axis."""
    gripper: bool
    """Whether the button of the gripper is down."""


def spacemouse() -> Iterator[Reading]:
    """Readings of a 3Dconnexion SpaceMouse, without end.

    Raises:
        DeviceError: No such device is plugged in, or its library is not installed.
    """
    try:
        import pyspacemouse  # pyright: ignore
    except ModuleNotFoundError as error:
        raise DeviceError("a SpaceMouse needs pip install 'manifeel-ms3[spacemouse]', and libhidapi") from error
    try:
        mouse = pyspacemouse.open(axis_convention="ros")  # pyright: ignore[reportArgumentType]; x forward, y left, z up, as the base
    except Exception as error:  # the library passes on whatever hidapi raises
        raise DeviceError(NO_DEVICE.format(name="SpaceMouse") + f" ({error})") from error
    while True:
        state = mouse.read()
        yield Reading({axis: getattr(state, axis) for axis in SIX_AXES}, any(state.buttons))


def gamepad() -> Iterator[Reading]:
    """Readings of the first gamepad, without end.

    The left stick moves along x and y, the right stick along z and about yaw, the shoulder buttons turn about roll, the
    directional pad about pitch, and the lowest button toggles the gripper. Sticks and buttons have the names of SDL's
    controllers, because their numbers differ from gamepad to gamepad and between operating systems.

    Raises:
        DeviceError: No such device is plugged in, or its library is not installed.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # events need a display, which a server does not have
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
        return pad.get_axis(getattr(pygame, f"CONTROLLER_AXIS_{name}")) / STICK_RANGE

    def buttons(up: str, down: str) -> float:
        pressed = [pad.get_button(getattr(pygame, f"CONTROLLER_BUTTON_{name}")) for name in (up, down)]
        return float(pressed[0] - pressed[1])

    while True:
        pygame.event.pump()
        axes = dict(x=-stick("LEFTY"), y=-stick("LEFTX"), z=-stick("RIGHTY"), yaw=-stick("RIGHTX"))
        axes |= dict(roll=buttons("RIGHTSHOULDER", "LEFTSHOULDER"), pitch=buttons("DPAD_UP", "DPAD_DOWN"))
        yield Reading(axes, bool(pad.get_button(pygame.CONTROLLER_BUTTON_A)))


DEVICES: dict[str, Callable[[], Iterator[Reading]]] = dict(spacemouse=spacemouse, gamepad=gamepad)


def follow(readings: Iterator[Reading], operator: Operator) -> threading.Thread:
    """Push an operator with the readings of a device, from a thread; the first reading is taken at once.

    Raises:
        DeviceError: The device cannot be used.
    """
    first = next(readings)

    def read() -> None:
        was_down, moving = first.gripper, set[str]()
        try:
            for reading in readings:
                for axis, value in reading.axes.items():
                    if abs(value) > DEAD_ZONE:
                        operator.push(axis, value)
                        moving.add(axis)
                    elif axis in moving:  # released: unlike a key, it need not be held on to
                        operator.push(axis, 0.0)
                        moving.discard(axis)
                if reading.gripper and not was_down:
                    operator.toggle_gripper()
                was_down = reading.gripper
                time.sleep(1.0 / RATE)
        except Exception as error:  # of a device's library, whatever it raises when the device is unplugged
            operator.pause()
            log.warning(
                "the device is lost (%s), and the robot waits; go on with the page, or plug it in and start again", error
            )

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    return thread
