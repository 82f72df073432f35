"""tactip import, transfer and camera: real sensors, their sets, and what a network of simulation makes of them."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tactip_twin.commands._progress import Waiting, to_stderr
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.layout import Layout, read_layout
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.sim2real.transfer.settings import TransferSettings
from tactip_twin.tactip_model.bounds import check, within


@dataclass(frozen=True)
class Import:
    """Bring a set of a real sensor, published or your own, into the project's format, and picture what was made of it."""

    source: tyro.conf.Positional[Path]
    """Folder of the set: a table, frames (or films) in it or in images/, frames/ or videos/, and a neutral image init* or
    neutral* if there is one."""
    out: Path
    """Folder to write."""
    targets: Path | None = None
    """The table of poses; if not given, SOURCE/targets.csv, or the only table there is."""
    neutral: Path | None = None
    """Image of the undeformed tip. If there is none, the middle of the shallowest frames stands for it."""
    layout: Path | None = None
    """JSON file of the options below; those that are given beside it come before its."""
    column_map: Annotated[ColumnMap, tyro.conf.arg(name="")] = field(default_factory=ColumnMap)
    """What the set's columns mean."""
    preprocessing: Annotated[ImagePreprocessing, tyro.conf.arg(name="")] = field(default_factory=ImagePreprocessing)
    """What the set's frames are like."""

    def run(self):
        from tactip_twin.sim2real.importing.import_set import PICTURE, import_set, read_source
        from tactip_twin.sim2real.importing.report import report_lines

        layout = self._layout()
        source = read_source(self.source, layout.column_map, self.targets, self.neutral)
        report = import_set(source, layout, self.out)
        for line in report_lines(report):
            print(line)
        print(f"{self.out} written; look at {self.out / PICTURE}")
        return 0

    def _layout(self):
        given = Layout(self.column_map, self.preprocessing)
        if self.layout is None:
            return given
        defaults = Layout().as_dict()
        changed = {name: value for name, value in given.as_dict().items() if value != defaults[name]}
        return Layout.from_dict(read_layout(self.layout).as_dict() | changed)


@dataclass(frozen=True)
class Transfer:
    """From simulation to a real sensor: train on simulated contacts of its twin, test on its frames. Run again, it goes on
    where it stopped."""

    experiment: tyro.conf.Positional[str]
    """zero-shot (no real label is used), ablate (what each part of the simulation is worth), few-shot, gap (pins and images
    side by side), or pseudo-real: all but the second on a hidden simulated sensor in the place of a real one."""
    out: Path
    """Folder for sets, networks, results.json and results.md."""
    real: Path | None = None
    """Folder of an imported set (tactip import); pseudo-real makes its own."""
    task: str = "surface"
    """surface or edge, of pseudo-real."""
    kind: str = "nominal-127"
    """nominal-127 or nominal-331: what the hidden sensor of pseudo-real is like."""
    frames: int = 2500
    """Frames of pseudo-real."""
    json: bool = False
    """Print the results, as JSON, in the place of words."""
    workers: str = "auto"
    """Worker processes that make contacts; auto is one a core."""
    device: str = "auto"
    """auto, cpu or cuda."""
    settings: Annotated[TransferSettings, tyro.conf.arg(name="")] = field(default_factory=TransferSettings)
    """How the experiments are made."""

    def run(self):
        from json import dumps

        with Waiting("loading the libraries"):
            from tactip_twin.sim2real.transfer.experiments import EXPERIMENTS, Experiment
            from tactip_twin.sim2real.transfer.page import PAGE, write_page
            from tactip_twin.tactip_model.errors import lookup

        lookup("experiment", self.experiment, dict.fromkeys([*EXPERIMENTS, "pseudo-real"]))
        say = to_stderr if self.json else print
        pseudo = self.experiment == "pseudo-real"
        names = ("zero-shot", "gap", "few-shot") if pseudo else (self.experiment,)
        with Waiting("reading the real set and its design"):
            experiment = Experiment(self._set(say), self.out, self.settings, self.workers, self.device, say)
        results = {}
        for name in names:
            results[name] = EXPERIMENTS[name](experiment)
            write_page(experiment.keep(name, results[name]), experiment.task, self.out)
        print(dumps(results if pseudo else results[self.experiment]) if self.json else f"{self.out / PAGE} written")
        return 0

    def _set(self, say):
        from tactip_twin.sim.parallel.worker_pool import worker_count
        from tactip_twin.sim2real.transfer.pseudo_real import make_pseudo_real
        from tactip_twin.tactip_model.errors import TactipError, lookup

        if self.experiment == "pseudo-real":
            if self.real is not None:
                raise TactipError(f"pseudo-real makes its own set, and --real {self.real} is given: leave it out")
            lookup("kind", self.kind, dict.fromkeys(("nominal-127", "nominal-331")))
            seed, workers = self.settings.seed, worker_count(self.workers)
            return make_pseudo_real(self.out / "hidden", self.task, self.kind, self.frames, seed, workers, say)
        if self.real is None:
            raise TactipError(f"{self.experiment} needs the folder of an imported set: give --real")
        return self.real


@dataclass(frozen=True)
class Camera:
    """A real sensor, live: pins, tactile image and what the network feels, a JSON line a frame, and in a browser. The first
    frame should show the tip untouched."""

    device: int | None = within(0, 1000, default=None)
    """Number of a camera of this machine."""
    video: Path | None = None
    """A film in the camera's place."""
    images: Path | None = None
    """A folder of images in its place."""
    model: str = "surface-tactip-127"
    """A shipped network or the folder of a training; none for none."""
    neutral: Path | None = None
    """Image of the untouched tip; the first frame if not given."""
    page: bool = False
    """Show it in a browser, too."""
    host: str = "127.0.0.1"
    """Address that the page is served at."""
    port: int = 8080
    """Its port, or the next that is free."""
    frames: int = within(0, 10**9, default=0)
    """Stop after so many frames; 0: go on to the end."""
    preprocessing: Annotated[ImagePreprocessing, tyro.conf.arg(name="")] = field(
        default_factory=lambda: ImagePreprocessing(threshold=(61, -5.0))
    )
    """What its frames are like, and what is used of them."""

    def __post_init__(self):
        check(self)

    def run(self):
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
            page = self._page()
            count, faults, last = 0, 0, 0.0
            # A camera never ends by itself: Ctrl-C is how it does.
            with suppress(KeyboardInterrupt):
                for sight in LiveSensor(source, self.preprocessing, model, neutral):
                    print(dumps(sight.as_json()), flush=True)
                    count, faults, last = count + 1, faults + bool(sight.fault), sight.time_s
                    if page:
                        page.show(sight, count / max(last, 1e-9))
                    if count == self.frames:
                        break
                else:
                    if page:
                        print("that was the last frame, which the page goes on showing: Ctrl-C ends it", file=sys.stderr)
                        Event().wait()
            rate = (count - 1) / last if count > 1 else 0.0
            print(f"{count} frames, {faults} of them faulty; {rate:.1f} frames/s", file=sys.stderr)
        finally:
            source.close()
            if page:
                page.close()
        return 0

    def _source(self):
        from tactip_twin.sim2real.sensor.frame_sources import CameraFrames, ImageFrames
        from tactip_twin.sim2real.sensor.video_frames import FilmFrames
        from tactip_twin.tactip_model.errors import TactipError

        given = [x for x in (self.device, self.video, self.images) if x is not None]
        if len(given) != 1:
            raise TactipError(f"{len(given)} sources of frames are given: give one of --device, --video and --images")
        if self.device is not None:
            return CameraFrames(self.device)
        return FilmFrames(self.video) if self.video is not None else ImageFrames(self.images)

    def _page(self):
        if not self.page:
            return None
        from tactip_twin.sim2real.sensor.live_page import CameraPage

        page = CameraPage(f"camera, {self.model}", self.host, self.port)
        print(f"the page is at {page.address}", file=sys.stderr)
        return page
