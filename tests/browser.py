"""Headless Chromium, driven over its DevTools protocol."""

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path
from types import TracebackType
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def browser_program() -> str | None:
    return next((found for name in NAMES if (found := shutil.which(name))), None)


class Browser:
    """A page in a browser of its own."""

    def __init__(self, address: str, folder: Path, size: tuple[int, int] = (1400, 900)):
        from websockets.sync.client import connect

        program = browser_program()
        assert program, "no Chromium"
        options = [*FLAGS, "--remote-debugging-port=0", f"--user-data-dir={folder}", f"--window-size={size[0]},{size[1]}"]
        self._process = subprocess.Popen([program, *options, address], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._number = 0
        port_file = folder / "DevToolsActivePort"
        try:
            wait_until(lambda: port_file.is_file() and len(port_file.read_text().split()) == 2)
            port = port_file.read_text().split()[0]
            with urllib.request.urlopen(f"http://localhost:{port}/json/list", timeout=60) as answer:
                (page,) = [target for target in json.load(answer) if target["type"] == "page"]
            self._socket = connect(page["webSocketDebuggerUrl"], max_size=None)
        except BaseException:
            self._process.kill()
            raise

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait()

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self._number += 1
        self._socket.send(json.dumps(dict(id=self._number, method=method, params=params)))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    @property
    def text(self) -> str:
        return self.evaluate("document.body.innerText") or ""

    def press(self, key: str, code: str, number: int, times: int = 1) -> None:
        """Hold a key down for a number of repeats."""
        event = dict(key=key, code=code, windowsVirtualKeyCode=number)
        for repeat in range(times):
            self.call("Input.dispatchKeyEvent", type="keyDown", autoRepeat=repeat > 0, **event)
            time.sleep(0.05)
        self.call("Input.dispatchKeyEvent", type="keyUp", **event)

    def click(self, label: str) -> None:
        """Click the button that has this text."""
        found = self.evaluate(
            f"(() => {{const b = [...document.querySelectorAll('button')].find(b => b.innerText.trim() == {json.dumps(label)});"
            " if (b) b.click(); return !!b})()"
        )
        assert found, f"no button {label!r} in {self.text}"

    def screenshot(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))


def wait_until(condition, seconds: float = 60.0, page: Browser | None = None) -> None:
    """Wait until a condition holds; where it does not, the error says what the page shows."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition did not become true in time" + (f" on {page.text!r}" if page else "")
        time.sleep(0.1)
