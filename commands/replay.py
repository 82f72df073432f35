"""tactip replay: a recording in a browser, in a window, as a video, as a GIF or as a page to send."""

import contextlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from tactip_twin.commands._pages import serve_until_interrupted
from tactip_twin.commands._parsing import Command
from tactip_twin.tactip_model.errors import TactipError

if TYPE_CHECKING:
    import numpy as np

    from tactip_twin.sim.robot.recording import RecordedScene


@dataclass(frozen=True)
class Replay(Command):
    """Show a recording in a browser, or write a video, a GIF or a page of it. Nothing is simulated again."""

    example = "tactip replay runs/servo-bust --video bust.mp4"

    run_: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="run")]
    """Folder of a run of `tactip servo` or `tactip track`, or of a recorded contact."""
    video: Path | None = None
    """Video file to write (.mp4)."""
    gif: Path | None = None
    """GIF file to write (.gif)."""
    html: Path | None = None
    """Page to write (.html): one file with scene, image and curves that opens in a browser, without a server or network."""
    stride: int = 1
    """Number of servo steps per video frame, or per step of the page that is written."""
    fps: int = 25
    """Video frames per second."""
    window: bool = False
    """Show the recording in MuJoCo's window instead of a browser; needs a display."""
    host: str = "127.0.0.1"
    """Address at which the page is served; 127.0.0.1: this machine only."""
    port: int = 8080
    """Port of the page; if it is taken, the next free one."""

    def run(self) -> int:
        from tqdm import tqdm

        from tactip_twin.sim.robot.recording import check_skin, read_recorded_scene, read_recording
        from tactip_twin.sim.view.replay_html import write_replay_html
        from tactip_twin.sim.view.replay_video import render_frames
        from tactip_twin.sim.view.video import write_video

        if self.stride < 1 or self.fps < 1:
            raise TactipError(f"--stride and --fps must be at least 1, got {self.stride} and {self.fps}")
        asked = [(path, ending) for path, ending in ((self.video, ".mp4"), (self.gif, ".gif")) if path is not None]
        pages = [(self.html, ".html")] if self.html is not None else []
        for path, ending in (*asked, *pages):
            if path.suffix.lower() != ending:
                raise TactipError(f"the file name must end in {ending}, got {path}")
            path.parent.mkdir(parents=True, exist_ok=True)
        (record, arrays), scenery = read_recording(self.run_), read_recorded_scene(self.run_)
        check_skin(scenery, arrays)
        if not record["complete"]:
            print(f"{self.run_} is incomplete: the run was interrupted after {record['steps']} steps", file=sys.stderr)
        count = -(-record["steps"] // self.stride)
        for path, _ in asked:
            drawn = render_frames(scenery, record, arrays, self.stride)
            write_video(path, tqdm(drawn, total=count, unit="picture", file=sys.stderr, disable=not count), self.fps)
            print(f"{path} written")
        for path, _ in pages:
            write_replay_html(path, record, arrays, scenery, self.stride)
            print(f"{path} written, {path.stat().st_size / 1e6:.1f} MB")
        if asked or pages:
            return 0
        return self._open(record, arrays, scenery) if self.window else self._serve(record, arrays, scenery)

    def _open(self, record: dict[str, Any], arrays: dict[str, "np.ndarray"], scenery: "RecordedScene") -> int:
        """Show the recording in a window. Return the exit status."""
        from tactip_twin.sim.view.replay_window import ReplayWindow

        with contextlib.suppress(KeyboardInterrupt):
            ReplayWindow(record, arrays, scenery).run()
        return 0

    def _serve(self, record: dict[str, Any], arrays: dict[str, "np.ndarray"], scenery: "RecordedScene") -> int:
        """Show the recording in a browser. Return the exit status."""
        from tactip_twin.sim.view.replay_page import ReplayPage

        page = ReplayPage(record, arrays, scenery, self.host, self.port)
        print(f"{page.address} shows {self.run_}; stop with Ctrl-C", flush=True)
        return serve_until_interrupted(page)
