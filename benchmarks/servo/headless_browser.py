"""A headless Chromium that opens a page, is clicked, and is looked at: over its debugging protocol, without a driver."""

import base64
import contextlib
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

import cv2
import numpy as np
from websockets.sync.client import connect

PROGRAM = shutil.which("chromium")

_BUTTON = """(() => {{
  const all = [...document.querySelectorAll('button, label')].filter(b => b.innerText.trim() === {text});
  if (!all.length) return null;
  const q = all[0].getBoundingClientRect();
  return [q.x + q.width / 2, q.y + q.height / 2];
}})()"""


class Chromium:
    """A page in a browser without a screen and without a GPU."""

    def __init__(self, address, size=(1280, 860), wait=True):
        """address: str. size: (2,) px. wait: bool; without, the page is empty until `open`."""
        self._folder = tempfile.mkdtemp()
        options = ["--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
        options += ["--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", f"--window-size={size[0]},{size[1]}"]
        options += ["--remote-debugging-port=0", "--remote-allow-origins=*", f"--user-data-dir={self._folder}"]
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen([str(PROGRAM), *options, address if wait else "about:blank"], **silent)  # noqa: S603
        self._socket, self._count = connect(self._find(), max_size=None), 0
        self._address = address

    def open(self):
        """Go to the address."""
        self.do("Page.navigate", url=self._address)

    def _find(self):
        """Address of the page's debugging socket."""
        told = Path(self._folder) / "DevToolsActivePort"
        for _ in range(240):
            with contextlib.suppress(OSError, IndexError, ValueError):
                port = int(told.read_text().splitlines()[0])
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                    pages = [page for page in json.load(answer) if page["type"] == "page"]
                if pages:
                    return pages[0]["webSocketDebuggerUrl"]
            time.sleep(0.25)
        raise AssertionError("Chromium does not come up")

    def do(self, method, **parameters):
        """One command of the protocol; returns its result (dict)."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            if message.get("id") == self._count:
                return message["result"]

    def ask(self, expression):
        """Value of an expression in the page."""
        return self.do("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def frames(self, count=3):
        """Wait until so many pictures were drawn: what the page was told is then where it is drawn, and can be hit."""
        wait = (
            f"(async () => {{ for (let i = 0; i < {count}; i++) await new Promise(requestAnimationFrame); return true; }})()"
        )
        self.do("Runtime.evaluate", expression=wait, awaitPromise=True)

    def text(self):
        """All that is written on the page."""
        return self.ask("document.body ? document.body.innerText : ''") or ""

    def until(self, holds, seconds=60.0):
        """Wait until holds() is true. Returns what it gave."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            got = holds()
            if got:
                return got
            time.sleep(0.05)
        raise AssertionError(f"it did not come: {self.text()[:400]!r}")

    def mouse(self, kind, place):
        """Press, move or release the left button: kind mousePressed, mouseMoved or mouseReleased; place (2,) px."""
        count = {} if kind == "mouseMoved" else {"clickCount": 1}
        self.do("Input.dispatchMouseEvent", type=kind, x=place[0], y=place[1], button="left", **count)

    def click(self, text):
        """Click on the button with a text."""
        place = self.until(lambda: self.ask(_BUTTON.format(text=json.dumps(text))))
        self.mouse("mousePressed", place)
        self.mouse("mouseReleased", place)

    def write(self, field, text):
        """Put a text into the first field of a CSS selector, in the place of what is there."""
        self.ask(f"(() => {{ const f = document.querySelector({json.dumps(field)}); f.focus(); f.select(); }})()")
        self.do("Input.insertText", text=text)
        self.key("Tab", "Tab")

    def key(self, key, code):
        """Press a key: its name and its code, as in KeyboardEvent."""
        for kind in ("keyDown", "keyUp"):
            self.do("Input.dispatchKeyEvent", type=kind, key=key, code=code, windowsVirtualKeyCode=ord(key[0].upper()))

    def picture(self):
        """What is to be seen: (h, w, 3) uint8, red, green and blue."""
        data = base64.b64decode(self.do("Page.captureScreenshot", format="png")["data"])
        return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))[..., ::-1]

    def close(self):
        """End it."""
        self._socket.close()
        self._process.terminate()
        self._process.wait(20)
        shutil.rmtree(self._folder, ignore_errors=True)
