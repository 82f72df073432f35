"""Make the pictures of docs/ that are not a measurement's: python scripts/docs_pictures.py [NAME...]

Names are those of PICTURES; default: all. Pages are shown by a headless Chromium. Runs and sets stay in build/docs-pictures,
so a picture of a page that has changed takes seconds.
"""

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from tactip_twin.commands import main as tactip
from tactip_twin.commands._pose_reader import load_pose_reader
from tactip_twin.commands.camera import Camera
from tactip_twin.learning.model import load_network
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.robot.recording import read_recorded_scene, read_recording
from tactip_twin.sim.view.live_page import LivePage
from tactip_twin.sim.view.replay_page import ReplayPage
from tactip_twin.sim2real.sensor.live import LiveSensor
from tactip_twin.sim2real.sensor.live_page import CameraPage
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.renderer import renderer_named

ROOT = Path(__file__).resolve().parents[1]
DOCS, WORK = ROOT / "docs", ROOT / "build" / "docs-pictures"

sys.path.insert(0, str(ROOT / "tests"))
from helpers.headless_browser import Chromium  # pyright: ignore[reportMissingImports]  # noqa: E402

SIZE_PX, LAPTOP_PX = (1400, 900), (1280, 720)
"""Sizes of a browser's window."""

_BITS = 6
"""Bits per color of a picture of a page: files become two thirds as large."""

_TUTORIAL_PX = 1080
"""Width of the tutorial's figure."""


def run(*words: str) -> None:
    """Run a tactip command. Raises SystemExit if it fails."""
    if tactip.main(list(words)):
        raise SystemExit(f"failed: tactip {shlex.join(words)}")


def pass_over_the_bust() -> Path:
    """Return the folder of a pass over the bust's face, which is made if it is missing."""
    folder = WORK / "pass"
    if not folder.exists():
        run("servo", "--task", "surface", "--object", "bust", "--route.kind", "straight", "--out", str(folder))
    return folder


def browser_at(address: str, size: tuple[int, int] = SIZE_PX) -> Chromium:
    """Return a browser with a page, in a window of a size, px."""
    browser = Chromium(address, size)
    browser.do("Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False)
    return browser


def save(browser: Chromium, name: str) -> None:
    """Write a screenshot to a file of docs/, and end the browser."""
    browser.evaluate("document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click())")
    browser.evaluate("new Promise(done => setTimeout(done, 1000))")
    browser.frames(10)
    levels = 2**_BITS - 1
    coarse = np.round(np.round(browser.screenshot() / 255 * levels) / levels * 255).astype(np.uint8)
    Image.fromarray(coarse).save(DOCS / name, optimize=True)
    browser.close()


def replay_page() -> None:
    """Make docs/replay_page.png: the page of `tactip replay --html`, near the end of a pass."""
    folder, page = pass_over_the_bust(), WORK / "pass.html"
    run("replay", str(folder), "--html", str(page))
    steps = read_recording(folder)[0]["steps"]
    browser = browser_at(f"{page.as_uri()}#{round(0.95 * steps)},close")
    browser.until(lambda: f"of {steps - 1}" in browser.text())
    save(browser, "replay_page.png")


def served_replay_page() -> None:
    """Make docs/served_replay_page.png: the page of `tactip replay` on a laptop's screen, from inside the tip."""
    folder = pass_over_the_bust()
    record, arrays = read_recording(folder)
    page = ReplayPage(record, arrays, read_recorded_scene(folder))
    browser = browser_at(page.address, LAPTOP_PX)

    def shown() -> bool:
        page.run(seconds=0.1)
        return f"of {record['steps'] - 1}" in browser.text()

    browser.until(shown, 60)
    page.playback.go(round(0.7 * record["steps"]))
    page.show()
    browser.click("inside")
    page.run(seconds=2)
    save(browser, "served_replay_page.png")
    page.close()


def replay_gif() -> None:
    """Make docs/replay.gif, the README's animation."""
    run("replay", str(pass_over_the_bust()), "--gif", str(DOCS / "replay.gif"), "--stride", "3", "--fps", "10")


def live_page() -> None:
    """Make docs/live_page.png: the page of `tactip view`, from inside the tip."""
    design = load_design("tactip-127")
    render, read = renderer_named("pyrender", design), load_pose_reader("", "surface", design)
    page = LivePage(design, "surface", fidelity_named("standard"), render, read)
    browser = browser_at(page.address)

    def until(holds: Callable[[], bool]) -> None:
        def turn() -> bool:
            page.run(seconds=0.1)
            return holds()

        browser.until(turn, 300)

    until(lambda: "at rest" in browser.text())
    fields = "document.querySelectorAll('.mantine-NumberInput-input')"
    browser.evaluate(f"{fields}.forEach((field, k) => {{ field.id = `number-${{k}}`; }})")
    # The tip is pressed on the surface, and then sheared.
    for number, value in ((2, "-4"), (3, "6"), (0, "3")):
        browser.write(f"#number-{number}", value)
        page.run(seconds=1)
        until(lambda: "at rest" in browser.text())
    browser.click("inside")
    page.run(seconds=2)
    save(browser, "live_page.png")
    page.close()


def camera_page() -> None:
    """Make docs/camera_page.png: the page of `tactip camera --browser`, with frames of the pass."""
    _, arrays = read_recording(pass_over_the_bust())
    name, render = "surface-curved-tactip-127", renderer_named("pyrender", load_design("tactip-127"))
    model = load_network(name)
    page = CameraPage(f"camera, {name}", model)
    greys = map(render, arrays["pin_tips_m"], arrays["directions"])
    frames = (np.repeat(grey[..., None], 3, -1) for grey in greys)
    options = Camera()
    for reading in LiveSensor(frames, options.preprocessing, model, None, options.filter):
        page.show(reading, (reading.number + 1) / max(reading.time_s, 1e-9))
    browser = browser_at(page.address)
    browser.until(lambda: "frames/s" in browser.text())
    save(browser, "camera_page.png")
    page.close()


def tutorial() -> None:
    """Make docs/tutorial_sheet.png and tutorial_errors.png by the commands of the tutorial's first two sections."""
    text = (DOCS / "tutorial.md").read_text().partition("\n## 3.")[0].replace("\\\n", " ")
    folder = WORK / "tutorial"
    folder.mkdir(parents=True, exist_ok=True)
    for block in re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        for line in block.splitlines():
            words = shlex.split(line)
            if words[0] == "make":
                words += ["-C", str(ROOT), f"OUT={folder / 'data'}"]
            else:
                words[0] = str(Path(sys.executable).parent / "tactip")
            subprocess.run(words, cwd=folder, check=True)
    results = folder / "runs" / "tutorial"
    shutil.copyfile(results / "sheet.png", DOCS / "tutorial_sheet.png")
    figure = Image.open(results / "evaluation" / "errors.png").convert("RGB")
    height = round(_TUTORIAL_PX * figure.height / figure.width)
    figure.resize((_TUTORIAL_PX, height), Image.Resampling.LANCZOS).save(DOCS / "tutorial_errors.png", optimize=True)


PICTURES = {
    "replay-page": replay_page,
    "served-replay-page": served_replay_page,
    "replay-gif": replay_gif,
    "live-page": live_page,
    "camera-page": camera_page,
    "tutorial": tutorial,
}
"""Functions that make pictures, by name."""


def main(names: list[str]) -> None:
    """Make pictures. Raises SystemExit if a name is unknown."""
    if unknown := [name for name in names if name not in PICTURES]:
        raise SystemExit(f"unknown pictures {', '.join(unknown)}: choose some of {', '.join(PICTURES)}")
    for name in names or PICTURES:
        PICTURES[name]()
        print(f"{name} made")


if __name__ == "__main__":
    main(sys.argv[1:])
