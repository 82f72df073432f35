"""What a replay costs: how soon its page is there, pictures a second and processor of the host, and what a browser draws.

`tactip bench viewer`: records a servo run of some 500 steps (once), replays it in a process of its own, to no browser and
to a headless Chromium without a GPU, and writes docs/viewer.md and .json. Without Chromium, that part is left out and said.
"""

import json
import shutil
import time
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.servo.headless_browser import PROGRAM, Chromium
from tactip_twin.control.options import Options as ServoOptions
from tactip_twin.control.options import Settings
from tactip_twin.control.servo_run import run as follow
from tactip_twin.sim.robot.recording import STEPS, read_recorded_scene, read_recording
from tactip_twin.sim.view.replay_page import ReplayPage
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

SPEED = 4.0
"""Speed of the replay, so that every picture shows a step that is new."""

_RUN = ServoOptions(
    Path("-"), "edge", "rim-round", model="oracle", arm="kinematic", settings=Settings(step_mm=0.4, most_steps=520)
)
"""What is recorded: the 127-pin tip at the standard fidelity; by the truth, which is there without waiting."""

_READY = "document.body && document.body.innerText.includes('step 0') && !!document.querySelector('canvas')"

_COUNT = """(() => { window.drawn = 0; const count = () => { window.drawn++; requestAnimationFrame(count); };
requestAnimationFrame(count); })()"""


def run(options, say=print):
    """Measure. options: benchmarks.options.ViewerOptions. Returns the record (dict). say: called with lines for the user.

    Raises TactipError.
    """
    folder = options.runs / "recording"
    if not (folder / STEPS).exists():
        shutil.rmtree(folder, ignore_errors=True)
        say("recording a run: some minutes")
        follow(replace(_RUN, out=folder), say=say)
    alone = _measure(folder, options.seconds, browser=False)
    say(f"no browser: {alone['pictures_per_s']:.1f} pictures/s at {alone['processor']:.0%} of a core")
    seen = None
    if PROGRAM is None:
        say("there is no Chromium here: what a browser draws is not measured")
    else:
        seen = _measure(folder, options.seconds, browser=True)
        say(f"Chromium: ready in {seen['ready_s']:.1f} s, draws {seen['drawn_per_s']:.1f} pictures/s")
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
    write_file(options.out / "viewer.md", page(result).encode())
    return result


def _measure(folder, seconds, browser):
    """Figures (dict) of a replay in a process of its own."""
    context = get_context("spawn")
    here, there = context.Pipe()
    began = time.perf_counter()
    process = context.Process(target=_serve, args=(str(folder), seconds, there))
    process.start()
    there.close()
    try:
        address = _told(here, "the page's address")
        out = {"served_s": time.perf_counter() - began}
        chromium = Chromium(address, wait=False) if browser else None
        try:
            if chromium:
                out |= _looked_at(chromium)
            here.send("play")
            if chromium:
                chromium.ask(_COUNT)
                start = time.perf_counter()
            out |= _told(here, "what it cost")
            if chromium:
                out["drawn_per_s"] = chromium.ask("window.drawn") / (time.perf_counter() - start)
                out["heeded_s"] = _heeded(chromium)
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


def _told(pipe, what):
    """What the process tells next. Raises TactipError where it ended."""
    try:
        return pipe.recv()
    except EOFError:
        raise TactipError(f"the replay ended before it told {what}") from None


def _looked_at(chromium):
    """How soon the page is there (dict), from when the browser is told its address."""
    start = time.perf_counter()
    chromium.open()
    chromium.until(lambda: chromium.ask(_READY))
    return {"ready_s": time.perf_counter() - start}


def _heeded(chromium):
    """Time (s) from a click on Pause, while it plays, to when the page shows that it is heeded."""
    start = time.perf_counter()
    chromium.click("Pause")
    chromium.until(lambda: "Pause" not in chromium.text())
    return time.perf_counter() - start


def _serve(folder, seconds, pipe):
    """A replay that plays when it is told to, and tells what that cost."""
    record, arrays = read_recording(folder)
    viewer = ReplayPage(record, arrays, read_recorded_scene(folder))
    try:
        pipe.send(viewer.address)
        _until(viewer, pipe, "play")
        viewer.playback.speed = SPEED
        viewer.playback.toggle()
        viewer.show()
        clock, processor, pictures = time.perf_counter(), time.process_time(), viewer.pictures
        viewer.run(seconds)
        took = time.perf_counter() - clock
        figures = {
            "pictures_per_s": (viewer.pictures - pictures) / took,
            "processor": (time.process_time() - processor) / took,
        }
        if not viewer.playback.playing:
            raise TactipError(f"the recording is over after less than {seconds:g} s: it has {record['steps']} steps")
        # It goes on from the start, so that there is something to pause.
        viewer.playback.go(0)
        pipe.send(figures)
        _until(viewer, pipe, "end")
    finally:
        viewer.close()


def _until(viewer, pipe, word):
    """Serve until a word is told, or nothing can be any more."""
    while True:
        viewer.run(0.1)
        if pipe.poll():
            try:
                if pipe.recv() == word:
                    return
            except EOFError:
                return


def page(result):
    """The Markdown (str) of viewer.json."""
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
