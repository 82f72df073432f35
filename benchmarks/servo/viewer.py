"""Cost of a replay: start-up time of its page, frame rate and processor use of the host, and the frame rate of a browser.

`tactip bench viewer` records a servo run of some 500 steps (once), replays it in a process of its own, without a browser
and with a headless Chromium without a GPU, and writes docs/viewer.md and viewer.json. Where Chromium is not installed, its
part is left out with a message.
"""

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.options import ViewerOptions
from tactip_twin.benchmarks.servo.headless_browser import PROGRAM, Chromium
from tactip_twin.control.options import ServoOptions, Settings
from tactip_twin.control.servo_run import run_servo
from tactip_twin.sim.robot.recording import STEPS, read_recorded_scene, read_recording
from tactip_twin.sim.view.replay_page import ReplayPage
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

SPEED = 4.0
"""Speed of the replay, -: high enough that every frame shows a new step."""

_RUN = ServoOptions(
    Path("-"), "edge", "rim-round", model="oracle", arm="kinematic", settings=Settings(step_mm=0.4, max_steps=520)
)
"""The recorded run: the 127-pin tip at standard fidelity, with the true pose, which takes no time to estimate."""

_READY = "document.body && document.body.innerText.includes('step 0') && !!document.querySelector('canvas')"

_COUNT = """(() => { window.drawn = 0; const count = () => { window.drawn++; requestAnimationFrame(count); };
requestAnimationFrame(count); })()"""


def run(options: ViewerOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure, write viewer.json and viewer.md, and return the results.

    Progress goes to `log`. Raises TactipError.
    """
    folder = options.runs / "recording"
    if not (folder / STEPS).exists():
        shutil.rmtree(folder, ignore_errors=True)
        log("recording a run: some minutes")
        run_servo(replace(_RUN, out=folder), log=log)
    alone = _measure(folder, options.seconds, browser=False)
    log(f"no browser: {alone['pictures_per_s']:.1f} pictures/s at {alone['processor']:.0%} of a core")
    seen = None
    if PROGRAM is None:
        log("there is no Chromium here: what a browser draws is not measured")
    else:
        seen = _measure(folder, options.seconds, browser=True)
        log(f"Chromium: ready in {seen['ready_s']:.1f} s, draws {seen['drawn_per_s']:.1f} pictures/s")
    record, arrays = read_recording(folder)
    size = sum(path.stat().st_size for path in folder.iterdir() if path.suffix in (".json", ".npz"))
    result = {
        "machine": machine(),
        "steps": record["steps"],
        "skin": int(arrays["skin_m"].shape[1]),
        "megabytes": size / 1e6,
        "seconds": options.seconds,
        "alone": alone,
        "seen": seen,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    write_file(options.out / "viewer.json", (json.dumps(result, indent=1) + "\n").encode())
    write_file(options.out / "viewer.md", markdown(result).encode())
    return result


def _measure(folder: Path, seconds: float, browser: bool) -> dict[str, float]:
    """Return rates and times of a replay in a process of its own, with or without a browser."""
    context = get_context("spawn")
    here, there = context.Pipe()
    started = time.perf_counter()
    process = context.Process(target=_serve, args=(str(folder), seconds, there))
    process.start()
    there.close()
    try:
        address = _received(here, "the page's address")
        out = {"served_s": time.perf_counter() - started}
        chromium = Chromium(address, wait=False) if browser else None
        try:
            if chromium:
                out["ready_s"] = _opening_s(chromium)
            here.send("play")
            start = time.perf_counter()
            if chromium:
                chromium.evaluate(_COUNT)
                start = time.perf_counter()
            out |= _received(here, "what it cost")
            if chromium:
                out["drawn_per_s"] = chromium.evaluate("window.drawn") / (time.perf_counter() - start)
                out["heeded_s"] = _pause_latency_s(chromium)
            here.send("end")
        finally:
            if chromium:
                chromium.close()
        return out
    finally:
        here.close()
        process.join(30)
        if process.is_alive():
            process.terminate()


def _received(pipe: Connection, what: str) -> Any:
    """Return what the process sends next. Raises TactipError if it ended before."""
    try:
        return pipe.recv()
    except EOFError:
        raise TactipError(f"the replay ended before it told {what}") from None


def _opening_s(chromium: Chromium) -> float:
    """Return the time from navigating to the page until it is rendered, s."""
    start = time.perf_counter()
    chromium.open()
    chromium.until(lambda: chromium.evaluate(_READY))
    return time.perf_counter() - start


def _pause_latency_s(chromium: Chromium) -> float:
    """Return the time from a click on Pause, during playback, until the page shows that it is paused, s."""
    start = time.perf_counter()
    chromium.click("Pause")
    chromium.until(lambda: "Pause" not in chromium.text())
    return time.perf_counter() - start


def _serve(folder: str, seconds: float, pipe: Connection) -> None:
    """Serve a replay in this process: play it on command, and send what that cost."""
    record, arrays = read_recording(folder)
    viewer = ReplayPage(record, arrays, read_recorded_scene(folder))
    try:
        pipe.send(viewer.address)
        _until(viewer, pipe, "play")
        viewer.playback.speed = SPEED
        viewer.playback.toggle()
        viewer.show()
        started, processor, pictures = time.perf_counter(), time.process_time(), viewer.pictures
        viewer.run(seconds)
        took = time.perf_counter() - started
        figures = {
            "pictures_per_s": (viewer.pictures - pictures) / took,
            "processor": (time.process_time() - processor) / took,
        }
        if not viewer.playback.playing:
            raise TactipError(f"the recording is over after less than {seconds:g} s: it has {record['steps']} steps")
        # Playback restarts at the beginning, so there is something to pause.
        viewer.playback.go(0)
        pipe.send(figures)
        _until(viewer, pipe, "end")
    finally:
        viewer.close()


def _until(viewer: ReplayPage, pipe: Connection, word: str) -> None:
    """Serve until a word arrives, or the pipe is closed."""
    while True:
        viewer.run(0.1)
        if pipe.poll():
            try:
                if pipe.recv() == word:
                    return
            except EOFError:
                return


def markdown(result: dict[str, Any]) -> str:
    """Return the Markdown of viewer.json."""
    state = machine_text(result["machine"])
    alone, seen = result["alone"], result["seen"]
    lines = [
        "# What a replay costs",
        "",
        "Written by `tactip bench viewer`; do not edit. A recording of "
        f"{result['steps']} steps of the 127-pin tip ({result['skin']} vertices of skin, {result['megabytes']:.1f} MB), "
        f"played {SPEED:g} times as fast as it was made for {result['seconds']:g} s, in a process of its own. On: {state}.",
        "",
        "| | no browser | Chromium, no GPU |",
        "|---|---|---|",
    ]
    rows = [
        ("program started to page served, s", "served_s", "{:.1f}"),
        ("address given to page drawn, s", "ready_s", "{:.1f}"),
        ("pictures sent, 1/s", "pictures_per_s", "{:.1f}"),
        ("of a core, for the host", "processor", "{:.0%}"),
        ("pictures drawn by the browser, 1/s", "drawn_per_s", "{:.1f}"),
        ("a click heeded while it plays, s", "heeded_s", "{:.2f}"),
    ]
    for title, name, form in rows:
        cells = [form.format(of[name]) if of and name in of else "" for of in (alone, seen)]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    lines += ["", "The browser shares the machine with the host, and draws by the processor: with a GPU it draws more."]
    return "\n".join(lines) + "\n"
