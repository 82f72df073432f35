"""tactip calibrate: a design from real frames."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tactip_twin.commands._parsing import Command
from tactip_twin.sim2real.calibration.settings import FrameSelection, Settings
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError


@dataclass(frozen=True)
class Calibrate(Command):
    """Fit the sensor to real frames: lens, pins, materials, friction, rig. Rerun to resume."""

    example = "tactip calibrate lab/set --out mine.json"

    real: tyro.conf.Positional[Path]
    """Folder of the real set: frames, targets.csv and a neutral image init* or neutral*; also meta.json with the tap, unless
    `tactip protocol` wrote the table (sim2real/calibration/real_set.py)."""
    design: str | None = None
    """Design to start from: nominal-127, nominal-331, another preset, or a design file (.json). Default: a nominal design
    with the pins of the neutral image."""
    out: Path = Path("design.json")
    """Design file to write; --design of other commands takes it."""
    report: Path | None = None
    """Folder for the report. Default: the design file's name with `_calibration`."""
    selection: Annotated[FrameSelection, tyro.conf.arg(name="")] = field(default_factory=FrameSelection)
    """Frames to use."""

    def run(self) -> int:
        from dataclasses import replace

        from tactip_twin.sim2real.calibration.fit import calibrate
        from tactip_twin.sim2real.calibration.report import write_report
        from tactip_twin.tactip_model.presets import load_design

        if self.out.suffix != ".json":
            raise TactipError(f"the design file {self.out} must end in .json")
        for name in ("fit_frames", "test_frames"):
            count = getattr(self.selection, name)
            require(count >= 10, name, count, "at least 10")
        report = self.report or self.out.with_name(f"{self.out.stem}_calibration")
        settings = Settings(**vars(self.selection))
        result = calibrate(self.real, load_design(self.design) if self.design else None, settings, report / "state.json")
        design = replace(result.twin.design, name=self.out.stem)
        result = replace(result, twin=replace(result.twin, design=design))
        figures = write_report(result, self.real.resolve().name, settings, self.out, report)
        tested = figures["frames_px"]["fitted_fraction"]
        print(f"pin distance on test frames: {tested['rms']:.2f} px rms, median {tested['median']:.2f} px (256 px image)")
        print(f"{self.out} and {report / 'calibration.md'} written")
        return 0
