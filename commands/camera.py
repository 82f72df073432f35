"""tactip camera: a real sensor, live."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tactip_twin.commands._parsing import Command
from tactip_twin.learning.filter_settings import FilterSettings
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.tactip_model.bounds import check, within

if TYPE_CHECKING:
    from tactip_twin.learning.model import Model
    from tactip_twin.sim2real.sensor.frame_sources import CameraFrames, ImageFrames
    from tactip_twin.sim2real.sensor.live_page import CameraPage
    from tactip_twin.sim2real.sensor.video_frames import VideoFrames


@dataclass(frozen=True)
class Camera(Command):
    """Read a real sensor live: print pins, predicted pose and contact as one JSON line per frame. The first frame should
    show the undeformed tip."""

    common = ("device", "video", "images", "model", "neutral", "browser", "preprocessing.crop", "preprocessing.threshold")
    example = "tactip camera --device 0 --crop 150 40 510 400 --browser"

    device: int | None = within(0, 1000, default=None)
    """Number of a camera of this machine: 0, 1, … Give this, --video or --images."""
    video: Path | None = None
    """Video file to read instead of a camera."""
    images: Path | None = None
    """Folder of images to read instead of a camera."""
    model: str = "surface-tactip-127"
    """Shipped network, or folder of a training; none: no prediction."""
    neutral: Path | None = None
    """Image of the undeformed tip. Default: the first frame."""
    browser: bool = False
    """Also show frames and predictions in a browser."""
    host: str = "127.0.0.1"
    """Address at which the page is served; 127.0.0.1: this machine only."""
    port: int = 8080
    """Port of the page; if it is taken, the next free one."""
    frames: int = within(0, 10**9, default=0)
    """Number of frames after which to stop; 0: read to the end."""
    filter: FilterSettings = field(default_factory=lambda: FilterSettings(rest_mm=0.5, rest_deg=3.0, max_rejected=0))
    """Filter of poses over frames, for networks that estimate deviations."""
    preprocessing: Annotated[ImagePreprocessing, tyro.conf.arg(name="")] = field(
        default_factory=lambda: ImagePreprocessing(threshold=(61, -5.0))
    )
    """Preprocessing of the frames."""

    def __post_init__(self) -> None:
        check(self)

    def run(self) -> int:
        from contextlib import suppress
        from json import dumps
        from threading import Event

        from tactip_twin.learning.model import load_network
        from tactip_twin.sim2real.sensor.live import LiveSensor
        from tactip_twin.sim2real.sensor.preprocess import load_neutral

        source = self._source()
        page = None
        try:
            model = None if self.model == "none" else load_network(self.model)
            neutral = None if self.neutral is None else load_neutral(self.neutral)
            page = self._page(model)
            count, faults, last = 0, 0, 0.0
            # A camera has no end: Ctrl-C ends the command.
            with suppress(KeyboardInterrupt):
                for sight in LiveSensor(source, self.preprocessing, model, neutral, self.filter):
                    print(dumps(sight.as_json()), flush=True)
                    count, faults, last = count + 1, faults + bool(sight.fault), sight.time_s
                    if page:
                        page.show(sight, count / max(last, 1e-9))
                    if count == self.frames:
                        break
                else:
                    if page:
                        print("last frame; the page shows it until Ctrl-C", file=sys.stderr)
                        Event().wait()
            rate = (count - 1) / last if count > 1 else 0.0
            print(f"{count} frames, {faults} unusable; {rate:.1f} frames/s", file=sys.stderr)
        finally:
            source.close()
            if page:
                page.close()
        return 0

    def _source(self) -> "CameraFrames | VideoFrames | ImageFrames":
        """Return the source of the frames."""
        from tactip_twin.sim2real.sensor.frame_sources import CameraFrames, ImageFrames
        from tactip_twin.sim2real.sensor.video_frames import VideoFrames
        from tactip_twin.tactip_model.errors import TactipError

        count = sum(x is not None for x in (self.device, self.video, self.images))
        if count == 1:
            if self.device is not None:
                return CameraFrames(self.device)
            if self.video is not None:
                return VideoFrames(self.video)
            if self.images is not None:
                return ImageFrames(self.images)
        raise TactipError(f"one of --device, --video and --images must be given, got {count} of them")

    def _page(self, model: "Model | None") -> "CameraPage | None":
        """Return the page in a browser, or None without --browser."""
        if not self.browser:
            return None
        from tactip_twin.sim2real.sensor.live_page import CameraPage

        page = CameraPage(f"camera, {self.model}", model, self.host, self.port)
        print(f"the page is at {page.address}", file=sys.stderr)
        return page
