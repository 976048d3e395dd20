"""The page in a browser (viser): it shows the observations, and has the keys and buttons to steer with."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import cv2
import numpy as np
import viser
import viser.uplot

from manifeel_ms3.sensors.visualisation import observation_images
from manifeel_ms3.tasks.visuotactile_env import CONTROL_FREQ

from .local_server import LocalServer
from .operator import EpisodeCommand, Mode, Operator

TILE_HEIGHT = 360
"""Height of each image on the page, in pixels; set once, not tuned."""
PLOTTED_SECONDS = 15
"""Time that the plot of the contact force shows, in s; set once, not tuned."""
NUM_PLOTTED = PLOTTED_SECONDS * CONTROL_FREQ
"""Number of control steps in this time."""
PLOT_HEIGHT = 150
"""Height of that plot, in pixels."""
JPEG_QUALITY = 80
"""Quality, from 0 to 100, of the images that are sent to the page: good enough to steer by, and small."""
NOTICE_SECONDS = 4.0
"""Time for which the page shows who steers, in s."""
HOLD_HZ = 10.0
"""Rate in Hz at which a button that is held down repeats its push; `HOLD` needs at least 4 Hz."""
SPEED_RANGE, SPEED_STEP = (0.05, 1.0), 0.05
"""Smallest and largest speed on the slider, and its step, as shares of the full speed."""
KEY_PAUSE = 0.8
"""Time in s without an event of a key after which it counts as pressed anew. It is longer than systems wait before they repeat
a key that is held down."""
KEYS = {
    "W": ("x", 1.0),
    "S": ("x", -1.0),
    "A": ("y", 1.0),
    "D": ("y", -1.0),
    "R": ("z", 1.0),
    "F": ("z", -1.0),
    "Q": ("yaw", 1.0),
    "E": ("yaw", -1.0),
    "arrowup": ("pitch", 1.0),
    "arrowdown": ("pitch", -1.0),
    "arrowleft": ("roll", -1.0),
    "arrowright": ("roll", 1.0),
}
"""Axis and direction of each key, as seen from behind the robot: x is forward, y to the left."""
KEYS_OF_AXES = {
    "x": "**W S** forward, back",
    "y": "**A D** left, right",
    "z": "**R F** up, down",
    "yaw": "**Q E** turn",
    "roll": "arrows tilt",
    "gripper": "**G** gripper",
}
"""What the page says of the keys of each axis."""
KEYS_OF_EPISODES = ("**space** start, pause", "**enter** save", "**backspace** discard")
"""What the page says of the other keys."""


class Page:
    """The page in a browser. One client steers; others watch, and one of them can take over after that client has left.

    Args:
        operator: Receives the motions and commands of the client that steers.
        title: Title of the page.
        host: Address to listen on.
        port: Port to listen on; the next free one if it is taken.
        full_scales: Full scales of the pads that are shown, by name (`observation_images`).
    """

    def __init__(self, operator: Operator, title: str, host: str, port: int, full_scales: Mapping[str, float]):
        self.operator = operator
        self._full_scales = full_scales
        self._server = LocalServer(host, port, title)
        self._pilot: int | None = None
        self._rights = threading.Lock()
        self._forces: deque[float] = deque([0.0] * NUM_PLOTTED, NUM_PLOTTED)
        self.address = self._server.address
        self._server.on_client_connect(lambda client: self._claim(client.client_id))
        self._server.on_client_disconnect(self._left)
        self._build(title)

    # ---------------------------------------------------------------- for the session

    def show(self, obs: dict[str, Any], info: dict[str, Any]) -> None:
        """Show an observation and its `info`."""
        mosaic = _mosaic(list(observation_images(obs, self._full_scales).values()))
        self._server.scene.set_background_image(mosaic, format="jpeg", jpeg_quality=JPEG_QUALITY)
        self._forces.append(float(info.get("contact_force", 0.0)))
        self._plot.data = (np.arange(NUM_PLOTTED, dtype=float), np.array(self._forces))
        self._mode.content = f"**{self.operator.mode.value}**" + (" · success" if bool(info.get("success", False)) else "")

    def set_message(self, text: str) -> None:
        """Show a line of text."""
        self._line.content = text
        self._mode.content = f"**{self.operator.mode.value}**"

    def stop(self) -> None:
        """Stop serving the page."""
        self._server.stop()

    # ---------------------------------------------------------------- who steers

    def _claim(self, client_id: int | None) -> None:
        with self._rights:
            if self._pilot is None:
                self._pilot = client_id
        self._notify_clients()

    def _left(self, client: viser.ClientHandle) -> None:
        with self._rights:
            if self._pilot != client.client_id:
                return
            self._pilot = None
        self.operator.pause()
        self._notify_clients()

    def _notify_clients(self) -> None:
        """Show every client whether it steers."""
        for client_id, client in self._server.get_clients().items():
            text = "you steer" if client_id == self._pilot else "you watch; another page steers"
            if self._pilot is None:
                text = "nobody steers: take over"
            client.add_notification("Teleoperation", text, auto_close_seconds=NOTICE_SECONDS)

    def _if_pilot(self, do: Callable[[], None]) -> Callable[[Any], None]:
        """A callback of viser that ignores every client but the one that steers."""

        def callback(event: Any) -> None:
            if event.client_id == self._pilot:
                do()

        return callback

    # ---------------------------------------------------------------- the panel

    def _build(self, title: str) -> None:
        gui = self._server.gui
        gui.configure_theme(
            control_layout="fixed", control_width="large", dark_mode=True, show_logo=False, show_share_button=False
        )
        gui.add_markdown(f"### {title}")
        self._mode = gui.add_markdown("")
        self._line = gui.add_markdown("")
        commands = {command.value: partial(self.operator.command, command) for command in EpisodeCommand}
        self._buttons("robot", dict(start=self.operator.start, pause=self.operator.pause, stop=commands.pop("stop")))
        self._buttons("episode", commands)
        self._plot = gui.add_uplot(
            (np.arange(NUM_PLOTTED, dtype=float), np.zeros(NUM_PLOTTED)),
            (viser.uplot.Series(label="step"), viser.uplot.Series(label="contact force, N", stroke="#4aa3ff", width=2)),
            scales={"x": viser.uplot.Scale(time=False, auto=True), "y": viser.uplot.Scale(auto=True)},
            height=PLOT_HEIGHT,
        )
        low, high = SPEED_RANGE
        speed = gui.add_slider("speed", min=low, max=high, step=SPEED_STEP, initial_value=self.operator.speed)
        speed.on_update(self._if_pilot(lambda: setattr(self.operator, "speed", speed.value)))
        self._build_axes()
        take_over = gui.add_button("take over", hint="for a page that watches, after the page that steered has left")
        take_over.on_click(lambda event: self._claim(event.client_id))
        self._build_keys()

    def _build_axes(self) -> None:
        """Two buttons for every axis, and one for the gripper."""
        gui = self._server.gui
        with gui.add_folder("steer"):
            keys = [said for axis, said in KEYS_OF_AXES.items() if axis in self.operator.axes]
            gui.add_markdown("Keys (hold those of motions): " + " · ".join([*keys, *KEYS_OF_EPISODES]))
            for axis in dict.fromkeys(axis for axis, _ in KEYS.values() if axis in self.operator.axes):
                for sign, name in ((1.0, f"{axis} +"), (-1.0, f"{axis} -")):
                    push = self._if_pilot(partial(self.operator.push, axis, sign))
                    gui.add_button(name).on_hold(push, callback_hz=HOLD_HZ)
            if "gripper" in self.operator.axes:
                gui.add_button("gripper").on_click(self._if_pilot(self.operator.toggle_gripper))

    def _build_keys(self) -> None:
        for key, (axis, sign) in KEYS.items():
            if axis in self.operator.axes:
                self._key(f"{axis} {'+' if sign > 0 else '-'}", key, partial(self.operator.push, axis, sign))
        if "gripper" in self.operator.axes:
            self._key("gripper", "G", once_a_press(self.operator.toggle_gripper))
        self._key("start or pause", "space", once_a_press(self._start_or_pause))
        self._key("save", "enter", once_a_press(partial(self.operator.command, EpisodeCommand.SAVE)))
        self._key("discard", "backspace", once_a_press(partial(self.operator.command, EpisodeCommand.DISCARD)))

    def _buttons(self, label: str, named: dict[str, Callable[[], None]]) -> None:
        group = self._server.gui.add_button_group(label, tuple(named))
        group.on_click(lambda event: self._if_pilot(named[group.value])(event))

    def _key(self, label: str, key: Any, do: Callable[[], None]) -> None:
        self._server.gui.add_command(label, hotkey=key).on_trigger(self._if_pilot(do))

    def _start_or_pause(self) -> None:
        self.operator.pause() if self.operator.mode is Mode.RUNNING else self.operator.start()


def once_a_press(do: Callable[[], None], clock: Callable[[], float] = time.monotonic) -> Callable[[], None]:
    """The callback of a key that does something once for each press, although the system repeats a key that is held down.

    Args:
        do: What is to be done.
        clock: Function that returns the time in s.
    """
    last = -math.inf

    def pressed() -> None:
        nonlocal last
        before, last = last, clock()
        if last - before > KEY_PAUSE:
            do()

    return pressed


def _mosaic(images: list[np.ndarray]) -> np.ndarray:
    """Images uint8 (H, W, 3) side by side, in two rows."""
    tiles = [cv2.resize(image, (round(TILE_HEIGHT * image.shape[1] / image.shape[0]), TILE_HEIGHT)) for image in images]
    rows = [tiles[: (len(tiles) + 1) // 2], tiles[(len(tiles) + 1) // 2 :]]
    rows = [np.concatenate(row, axis=1) for row in rows if row]
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])
