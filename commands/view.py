"""tactip replay and view: pages in a browser, films."""

import contextlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tactip_twin.commands._pose_reader import reader_of
from tactip_twin.tactip_model.errors import TactipError


@dataclass(frozen=True)
class Replay:
    """Look at a recording again, in a browser, as a film or as a GIF; nothing is simulated anew."""

    run_: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="run")]
    """Folder of a servo run."""
    video: Path | None = None
    """Film to write, .mp4."""
    gif: Path | None = None
    """GIF to write, .gif."""
    every: int = 1
    """Steps a picture."""
    rate: int = 25
    """Pictures a second."""
    window: bool = False
    """Show it in MuJoCo's own window in the place of a page in a browser: for where there is a display."""
    host: str = "127.0.0.1"
    """Address to serve the page at: this machine alone."""
    port: int = 8080
    """Port, or the next that is free."""

    def run(self):
        from tqdm import tqdm

        from tactip_twin.sim.robot.recording import read_recorded_scene, read_recording
        from tactip_twin.sim.view.replay_video import render_frames
        from tactip_twin.sim.view.video import write_video

        if self.every < 1 or self.rate < 1:
            raise TactipError(f"--every is {self.every} and --rate {self.rate}: both must be at least 1")
        asked = [(path, ending) for path, ending in ((self.video, ".mp4"), (self.gif, ".gif")) if path is not None]
        for path, ending in asked:
            if path.suffix.lower() != ending:
                raise TactipError(f"the name {path} does not end in {ending}")
            path.parent.mkdir(parents=True, exist_ok=True)
        (record, arrays), scenery = read_recording(self.run_), read_recorded_scene(self.run_)
        if not record["complete"]:
            print(f"{self.run_} was not completed: it has {record['steps']} steps", file=sys.stderr)
        count = -(-record["steps"] // self.every)
        for path, _ in asked:
            drawn = render_frames(scenery, record, arrays, self.every)
            write_video(path, tqdm(drawn, total=count, unit="picture", file=sys.stderr, disable=not count), self.rate)
            print(f"{path} written")
        if asked:
            return 0
        return self._open(record, arrays, scenery) if self.window else self._serve(record, arrays, scenery)

    def _open(self, record, arrays, scenery):
        from tactip_twin.sim.view.replay_window import Window

        with contextlib.suppress(KeyboardInterrupt):
            Window(record, arrays, scenery).run()
        return 0

    def _serve(self, record, arrays, scenery):
        from tactip_twin.sim.view.replay_page import ReplayPage

        viewer = ReplayPage(record, arrays, scenery, self.host, self.port)
        print(f"{viewer.address} shows {self.run_}; Ctrl-C ends it", flush=True)
        return _until_stopped(viewer)


@dataclass(frozen=True)
class View:
    """The live scene in a browser: drag the stimulus, or move it by sliders, and see what the tip feels."""

    task: str = "surface"
    """surface or edge, or another stimulus: sphere, point, needle, knife, corner, hole."""
    design: str = "tactip-127"
    """tactip-127, tactip-331, or a design file (.json)."""
    fidelity: str = "standard"
    """draft, standard or reference."""
    model: str = ""
    """A shipped network or the folder of a training; the shipped one of task and design, if there is one and this is
    empty; `none` for none."""
    renderer: str = "pyrender"
    """pyrender, or raster: without OpenGL."""
    host: str = "127.0.0.1"
    """Address to serve the page at: this machine alone."""
    port: int = 8080
    """Port, or the next that is free."""

    def run(self):
        from tactip_twin.sim.contact.fidelity import fidelity_named
        from tactip_twin.sim.view.live_page import LivePage
        from tactip_twin.tactip_model.presets import find_design
        from tactip_twin.tactip_model.renderer import renderer_named

        design = find_design(self.design)
        render, read = renderer_named(self.renderer, design), reader_of(self.model, self.task, design)
        live = LivePage(design, self.task, fidelity_named(self.fidelity), render, read, self.host, self.port)
        print(f"{live.address} shows the tip {design.name} on the stimulus {self.task}; Ctrl-C ends it", flush=True)
        return _until_stopped(live)


def _until_stopped(page):
    """Serve a page (Viewer or Live) until Ctrl-C. Returns the exit status."""
    try:
        page.run()
    except KeyboardInterrupt:
        return 0
    finally:
        page.close()
