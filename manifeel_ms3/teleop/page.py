"""The page: what is seen and felt, and everything to steer with, in a browser (viser)."""

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import viser
import viser.uplot

from manifeel_ms3.sensors.visualisation import observation_images

from .operator import Mode, Operator, Wish

TILE = 360  # pixels, height of a picture
PLOTTED = 150  # steps
KEYS = {  # as one looks at the robot from behind: x is ahead, y to the left
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
HELP = """Keys (hold them): **W S** ahead, back · **A D** left, right · **R F** up, down · **Q E** turn · arrows tilt ·
**G** gripper · **space** start, pause · **enter** save · **backspace** discard"""


class Page:
    """One client steers; others watch, and may take over once that one has gone.

    Args:
        host: address to listen on.
    """

    def __init__(self, operator: Operator, title: str, host: str, port: int):
        self.operator = operator
        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # it tells of every page that comes and goes
        self._server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        self._pilot: int | None = None
        self._rights = threading.Lock()
        self._forces: deque[float] = deque([0.0] * PLOTTED, PLOTTED)
        self.address = f"http://{host}:{self._server.get_port()}"
        self._server.on_client_connect(lambda client: self._claim(client.client_id))
        self._server.on_client_disconnect(self._left)
        self._build(title)

    # ---------------------------------------------------------------- for the session

    def show(self, obs: dict[str, Any], info: dict[str, Any]) -> None:
        self._server.scene.set_background_image(_mosaic(list(observation_images(obs).values())), format="jpeg", jpeg_quality=80)
        self._forces.append(float(info.get("contact_force", 0.0)))
        self._plot.data = (np.arange(PLOTTED, dtype=float), np.array(self._forces))
        self._mode.content = f"**{self.operator.mode.value}**" + (" · success" if bool(info.get("success", False)) else "")

    def tell(self, text: str) -> None:
        self._line.content = text
        self._mode.content = f"**{self.operator.mode.value}**"

    def stop(self) -> None:
        self._server.stop()

    # ---------------------------------------------------------------- who steers

    def _claim(self, client_id: int | None) -> None:
        with self._rights:
            if self._pilot is None:
                self._pilot = client_id
        self._say_who_steers()

    def _left(self, client: viser.ClientHandle) -> None:
        with self._rights:
            if self._pilot != client.client_id:
                return
            self._pilot = None
        self.operator.pause()
        self._say_who_steers()

    def _say_who_steers(self) -> None:
        for client_id, client in self._server.get_clients().items():
            told = "you steer" if client_id == self._pilot else "you watch; another page steers"
            if self._pilot is None:
                told = "nobody steers: take over"
            client.add_notification("Teleoperation", told, auto_close_seconds=4.0)

    def _if_pilot(self, do: Callable[[], None]) -> Callable[[viser.GuiEvent], None]:
        """A callback that heeds the one who steers."""

        def callback(event: viser.GuiEvent) -> None:
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
        wishes = {wish.value: lambda wish=wish: self.operator.wish(wish) for wish in Wish}
        self._buttons("robot", dict(start=self.operator.start, pause=self.operator.pause, stop=wishes.pop("stop")))
        self._buttons("episode", wishes)
        self._plot = gui.add_uplot(
            (np.arange(PLOTTED, dtype=float), np.zeros(PLOTTED)),
            (viser.uplot.Series(label="step"), viser.uplot.Series(label="contact force, N", stroke="#4aa3ff", width=2)),
            scales={"x": viser.uplot.Scale(time=False, auto=True), "y": viser.uplot.Scale(auto=True)},
            height=150,
        )
        speed = gui.add_slider("speed", min=0.05, max=1.0, step=0.05, initial_value=self.operator.speed)
        speed.on_update(lambda event: self._if_pilot(lambda: setattr(self.operator, "speed", speed.value))(event))
        with gui.add_folder("steer"):
            gui.add_markdown(HELP)
            for axis in dict.fromkeys(axis for axis, _ in KEYS.values() if axis in self.operator.axes):
                for sign, name in ((1.0, f"{axis} +"), (-1.0, f"{axis} -")):
                    button = gui.add_button(name)
                    button.on_hold(
                        self._if_pilot(lambda axis=axis, sign=sign: self.operator.push(axis, sign)), callback_hz=10.0
                    )
            if "gripper" in self.operator.axes:
                gui.add_button("gripper").on_click(self._if_pilot(self.operator.toggle_gripper))
        take_over = gui.add_button("take over", hint="where the page that steered has gone")
        take_over.on_click(lambda event: self._claim(event.client_id))
        for key, (axis, sign) in KEYS.items():
            self._key(f"{axis} {'+' if sign > 0 else '-'}", key, lambda axis=axis, sign=sign: self.operator.push(axis, sign))
        self._key("gripper", "G", self.operator.toggle_gripper)
        self._key("start or pause", "space", self._start_or_pause)
        self._key("save", "enter", lambda: self.operator.wish(Wish.SAVE))
        self._key("discard", "backspace", lambda: self.operator.wish(Wish.DISCARD))

    def _buttons(self, label: str, named: dict[str, Callable[[], None]]) -> None:
        group = self._server.gui.add_button_group(label, tuple(named))
        group.on_click(lambda event: self._if_pilot(named[group.value])(event))

    def _key(self, label: str, key: str, do: Callable[[], None]) -> None:
        self._server.gui.add_command(label, hotkey=key).on_trigger(self._if_pilot(do))

    def _start_or_pause(self) -> None:
        self.operator.pause() if self.operator.mode is Mode.RUNNING else self.operator.start()


def _mosaic(pictures: list[np.ndarray]) -> np.ndarray:
    """Side by side, in two rows."""
    tiles = [cv2.resize(picture, (round(TILE * picture.shape[1] / picture.shape[0]), TILE)) for picture in pictures]
    rows = [tiles[: (len(tiles) + 1) // 2], tiles[(len(tiles) + 1) // 2 :]]
    rows = [np.concatenate(row, axis=1) for row in rows if row]
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])
