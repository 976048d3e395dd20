"""SpaceMouse and gamepad: what their drivers report becomes a push of the robot.

Test machines have no such devices. The gamepad is a virtual one of SDL. Of the SpaceMouse, a SpaceNavigator, the reports are
made up, and its library parses them.
"""

import ctypes
import struct
import sys
from pathlib import Path

import pytest

from manifeel_ms3.teleop.devices import DEVICES, DeviceError, Reading, follow, gamepad, spacemouse
from manifeel_ms3.teleop.operator import Operator
from tests.teleop.axes import AXES

FULL = 350  # counts of a SpaceMouse pushed all the way


def test_a_device_pushes_beyond_its_dead_zone():
    operator = Operator(AXES)
    rest = Reading(dict(x=0.01, z=0.0), gripper=False)
    readings = [rest, Reading(dict(x=0.5, z=0.05), gripper=True), Reading(dict(x=0.5, z=0.05), gripper=True)]
    follow(iter(readings), operator).join()
    assert operator.action() == pytest.approx([0.5 * operator.speed, 0, 0, 0, 0, 0, -1.0])


def test_a_device_that_is_released_stops_the_robot_at_once():
    operator = Operator(AXES, clock=lambda: 0.0)
    readings = [Reading(dict(x=x, roll=roll), gripper=False) for x, roll in ((0.5, 1.0), (0.5, 1.0), (0.02, 0.0))]
    follow(iter(readings), operator).join()
    assert not operator.action()[:6].any()


@pytest.mark.parametrize(("device", "library"), [("spacemouse", "pyspacemouse"), ("gamepad", "pygame")])
def test_a_device_whose_library_is_missing(monkeypatch, device, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(DeviceError, match=rf"pip install 'manifeel-ms3\[{device}\]'"):
        follow(DEVICES[device](), Operator(AXES))


# -------------------------------------------------------------------- gamepad


# numbers in SDL: kinds of joysticks; sticks of a virtual gamepad; its lowest button, its right shoulder button, and
# the lower end of its directional pad
GAMEPAD, WHEEL = 1, 2
LEFT_ASIDE, LEFT_BACK, RIGHT_ASIDE, RIGHT_BACK = range(4)
LOWEST, RIGHT_SHOULDER, PAD_DOWN = 0, 10, 12


@pytest.fixture
def sdl():
    """The SDL library of pygame, with joysticks initialised."""
    pygame = pytest.importorskip("pygame")
    files = list((Path(pygame.__file__).parents[1] / "pygame.libs").glob("libSDL2-2*"))
    if not files:
        pytest.skip("pygame's own SDL is in its Linux wheel alone")
    pygame.joystick.init()
    library = ctypes.CDLL(str(files[0]))
    library.SDL_JoystickOpen.restype = ctypes.c_void_p
    yield library
    while library.SDL_NumJoysticks():
        library.SDL_JoystickDetachVirtual(0)
    pygame.quit()


def plug_in(sdl: ctypes.CDLL, kind: int) -> ctypes.c_void_p:
    assert sdl.SDL_JoystickAttachVirtual(kind, 6, 15, 0) == 0
    return ctypes.c_void_p(sdl.SDL_JoystickOpen(0))


def test_a_gamepad(sdl):
    pad = plug_in(sdl, GAMEPAD)
    readings = gamepad()
    assert next(readings) == Reading(dict(x=0, y=0, z=0, yaw=0, roll=0, pitch=0), gripper=False)
    for axis, value in {LEFT_ASIDE: 0.5, LEFT_BACK: -1.0, RIGHT_ASIDE: -0.25, RIGHT_BACK: 0.75}.items():
        assert sdl.SDL_JoystickSetVirtualAxis(pad, axis, ctypes.c_int16(round(32767 * value))) == 0
    for button in (LOWEST, RIGHT_SHOULDER, PAD_DOWN):
        assert sdl.SDL_JoystickSetVirtualButton(pad, button, 1) == 0
    reading = next(readings)
    assert reading.axes == pytest.approx(dict(x=1.0, y=-0.5, z=-0.75, yaw=0.25, roll=1.0, pitch=-1.0), abs=1e-4)
    assert reading.gripper


def test_a_wheel_is_no_gamepad(sdl):
    plug_in(sdl, WHEEL)
    with pytest.raises(DeviceError, match="no gamepad was found"):
        next(gamepad())


# -------------------------------------------------------------------- SpaceMouse


class SpaceNavigator:
    """As hidapi presents one: a report has three axes, int16; 1 has the pushes (right, back, down), 2 the turns about them."""

    vendor_id, product_id = 0x046D, 0xC626
    product_string, manufacturer_string, serial_number, release_number = "SpaceNavigator", "3Dconnexion", "", 1

    def __init__(self):
        self.reports: list[bytes] = []

    def open(self) -> None: ...

    def set_nonblocking(self, nonblocking: bool) -> None: ...

    def read(self, size: int) -> bytes:
        return self.reports.pop(0) if self.reports else b""


@pytest.fixture
def space_navigator(monkeypatch):
    api = pytest.importorskip("pyspacemouse.api")
    device = SpaceNavigator()
    monkeypatch.setattr(api, "Enumeration", lambda: type("Devices", (), dict(find=lambda self: [device]))())
    return device


@pytest.mark.parametrize(
    ("channel", "counts", "axis", "value"),
    [
        (1, (0, -FULL, 0), "x", 1.0),  # pushed away from the person: ahead
        (1, (FULL, 0, 0), "y", -1.0),  # to the right
        (1, (0, 0, -FULL), "z", 1.0),  # lifted
        (2, (0, -FULL, 0), "roll", 1.0),  # tilted to the right
        (2, (-FULL, 0, 0), "pitch", 1.0),  # tilted ahead
        (2, (0, 0, -FULL), "yaw", 1.0),  # turned left, seen from above
    ],
)
def test_a_spacemouse(space_navigator, channel, counts, axis, value):
    readings = spacemouse()
    rest = next(readings)
    assert set(rest.axes.values()) == {0.0}
    assert not rest.gripper
    space_navigator.reports += [struct.pack("<Bhhh", channel, *counts), bytes([3, 1])]
    pushed, pressed = next(readings), next(readings)
    assert pushed.axes == pytest.approx(rest.axes | {axis: value})
    assert not pushed.gripper
    assert pressed.gripper


def test_no_spacemouse(monkeypatch):
    api = pytest.importorskip("pyspacemouse.api")
    monkeypatch.setattr(api, "Enumeration", lambda: type("Devices", (), dict(find=lambda self: []))())
    with pytest.raises(DeviceError, match="no SpaceMouse was found"):
        next(spacemouse())
