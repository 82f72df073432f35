"""A headless Chromium, controlled over its debugging protocol without a driver."""

import base64
import contextlib
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from websockets.sync.client import connect

T = TypeVar("T")

PROGRAM = shutil.which("chromium")
"""Path of Chromium; None if it is not installed."""

_BUTTON = """(() => {{
  const all = [...document.querySelectorAll('button, label')].filter(b => b.innerText.trim() === {text});
  if (!all.length) return null;
  const q = all[0].getBoundingClientRect();
  return [q.x + q.width / 2, q.y + q.height / 2];
}})()"""


class Chromium:
    """A page in a browser without a screen and without a GPU."""

    def __init__(self, address: str, size: tuple[int, int] = (1280, 860), wait: bool = True) -> None:
        """Start the browser.

        Args:
            address: Address of the page.
            size: Width and height of the window, px.
            wait: Open the page at once; otherwise the window is empty until `open`.
        """
        self._folder = tempfile.mkdtemp()
        options = ["--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
        options += ["--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", f"--window-size={size[0]},{size[1]}"]
        options += ["--remote-debugging-port=0", "--remote-allow-origins=*", f"--user-data-dir={self._folder}"]
        command = [str(PROGRAM), *options, address if wait else "about:blank"]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._socket, self._count = connect(self._find(), max_size=None), 0
        self._address = address

    def open(self) -> None:
        """Open the page."""
        self.do("Page.navigate", url=self._address)

    def _find(self) -> str:
        """Return the address of the page's debugging socket."""
        port_file = Path(self._folder) / "DevToolsActivePort"
        for _ in range(240):
            with contextlib.suppress(OSError, IndexError, ValueError):
                port = int(port_file.read_text().splitlines()[0])
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                    pages = [page for page in json.load(answer) if page["type"] == "page"]
                if pages:
                    return pages[0]["webSocketDebuggerUrl"]
            time.sleep(0.25)
        raise AssertionError("Chromium does not start")

    def do(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Run a command of the protocol and return its result."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            if message.get("id") == self._count:
                return message["result"]

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression in the page (JSON)."""
        return self.do("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def frames(self, count: int = 3) -> None:
        """Wait for some rendered frames, so what the page received is in place and can be clicked."""
        wait = (
            f"(async () => {{ for (let i = 0; i < {count}; i++) await new Promise(requestAnimationFrame); return true; }})()"
        )
        self.do("Runtime.evaluate", expression=wait, awaitPromise=True)

    def text(self) -> str:
        """Return all text on the page."""
        return self.evaluate("document.body ? document.body.innerText : ''") or ""

    def until(self, holds: Callable[[], T], seconds: float = 60.0) -> T:
        """Wait until holds() is true, and return its value. Raises AssertionError after some seconds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            value = holds()
            if value:
                return value
            time.sleep(0.05)
        raise AssertionError(f"it did not come: {self.text()[:400]!r}")

    def mouse(self, kind: str, place: Sequence[float]) -> None:
        """Press, move or release the left button: kind mousePressed, mouseMoved or mouseReleased; place (2,) px."""
        count = {} if kind == "mouseMoved" else {"clickCount": 1}
        self.do("Input.dispatchMouseEvent", type=kind, x=place[0], y=place[1], button="left", **count)

    def click(self, text: str) -> None:
        """Click on the button with a text."""
        place = self.until(lambda: self.evaluate(_BUTTON.format(text=json.dumps(text))))
        self.mouse("mousePressed", place)
        self.mouse("mouseReleased", place)

    def write(self, field: str, text: str) -> None:
        """Replace the text of the first field that matches a CSS selector."""
        self.evaluate(f"(() => {{ const f = document.querySelector({json.dumps(field)}); f.focus(); f.select(); }})()")
        self.do("Input.insertText", text=text)
        self.key("Tab", "Tab")

    def key(self, key: str, code: str) -> None:
        """Press a key: its name and its code, as in KeyboardEvent."""
        for kind in ("keyDown", "keyUp"):
            self.do("Input.dispatchKeyEvent", type=kind, key=key, code=code, windowsVirtualKeyCode=ord(key[0].upper()))

    def screenshot(self) -> np.ndarray:
        """Return a screenshot (h, w, 3) uint8, red, green and blue."""
        data = base64.b64decode(self.do("Page.captureScreenshot", format="png")["data"])
        return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))[..., ::-1]

    def close(self) -> None:
        """End the browser."""
        self._socket.close()
        self._process.terminate()
        self._process.wait(20)
        shutil.rmtree(self._folder, ignore_errors=True)
