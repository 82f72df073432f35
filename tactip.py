"""The front door: one subcommand for each job, nothing else."""

import sys
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated

import tyro

from tactip_model.errors import Stopped, TactipError

Range = tuple[float, float]


@dataclass(frozen=True)
class RangeOptions:
    """Low and high of each component. What is not given is the paper's (Table 1) for the task."""

    x_mm: Range | None = None
    """Horizontal, square to the edge, mm."""
    y_mm: Range | None = None
    """Horizontal, along the edge, mm."""
    depth_mm: Range | None = None
    """Depth, negative into the object, mm."""
    roll_deg: Range | None = None
    """Rotation vector about x, degrees."""
    pitch_deg: Range | None = None
    """Rotation vector about y, degrees."""
    yaw_deg: Range | None = None
    """Rotation vector about the normal, degrees."""


@dataclass(frozen=True)
class Make:
    """Make labelled, sheared tactile images with the simulated sensor. Run again, it goes on where it stopped."""

    out: Path
    """Folder of the set; of the sets (OUT/TASK/SPLIT) if task or split is all."""
    task: str = "surface"
    """surface, edge, or all."""
    split: str = "train"
    """train, val, test, or all: independent draws."""
    samples: int = 200
    """Contacts in a set; the paper has 2000."""
    seed: int = 0
    """Seed of the draws."""
    workers: str = "auto"
    """Worker processes; auto is one a core."""
    fidelity: str = "standard"
    """draft, standard or reference (sim/fidelity.py)."""
    design: str = "tactip-127"
    """tactip-127, tactip-331, or a design file (.json) as `tactip calibrate` writes it."""
    renderer: str = "pyrender"
    """pyrender, or raster: the same image without OpenGL."""
    pose: RangeOptions = field(default_factory=RangeOptions)
    """Labelled poses."""
    shear: RangeOptions = field(default_factory=RangeOptions)
    """Unlabelled perturbations."""

    def run(self):
        from sim.crew import worker_count
        from sim.generation import make

        results = make(self._jobs(), worker_count(self.workers))
        failed = 0
        for r in results:
            failed += r["failed"]
            made = f", {r['made']} of them now" if r["made"] else ", complete already"
            print(f"{r['folder']}: {r['kept']} of {r['asked']} samples{made}; {r['failed']} failed")
        made, seconds = sum(r["made"] for r in results), max(r["seconds"] for r in results)
        if made:
            print(f"{made} samples in {seconds:.1f} s: {made / seconds:.2f} samples/s")
        if failed:
            print(f"{failed} contacts failed each try and were left out: meta.json names them and says why")
        return 0

    def _jobs(self):
        from sim.dataset import Configuration
        from sim.fidelity import fidelity_named
        from sim.generation import Job
        from sim.sampling import POSE_RANGES, SHEAR_RANGES, SPLITS
        from sim.stimulus import TASKS
        from tactip_model.errors import choose
        from tactip_model.presets import find_design

        choose("task", self.task, dict.fromkeys([*TASKS, "all"]))
        choose("split", self.split, dict.fromkeys([*SPLITS, "all"]))
        tasks = TASKS if self.task == "all" else (self.task,)
        splits = SPLITS if self.split == "all" else (self.split,)
        several = "all" in (self.task, self.split)
        jobs = []
        for task in tasks:
            for split in splits:
                configuration = Configuration(
                    task=task,
                    split=split,
                    samples=self.samples,
                    seed=self.seed,
                    renderer=self.renderer,
                    design=find_design(self.design),
                    fidelity=fidelity_named(self.fidelity),
                    pose=_with_options(POSE_RANGES[task], self.pose),
                    shear=_with_options(SHEAR_RANGES, self.shear),
                )
                jobs.append(Job(configuration, self.out / task / split if several else self.out))
        return jobs


def _with_options(ranges, options):
    """Ranges with those that RangeOptions names put in their place."""
    from dataclasses import replace

    given = {f.name: getattr(options, f.name) for f in fields(options) if getattr(options, f.name) is not None}
    return replace(ranges, **given)


@dataclass(frozen=True)
class Verify:
    """Check that a set is whole: images, rows, pins, checksums, one configuration."""

    folder: tyro.conf.Positional[Path]
    """Folder of the set."""

    def run(self):
        from sim.dataset import read_meta
        from sim.verification import verify

        problems = verify(self.folder)
        for problem in problems:
            print(f"{self.folder}: {problem}", file=sys.stderr)
        if problems:
            print(f"{self.folder}: {len(problems)} problem(s)", file=sys.stderr)
            return 1
        samples = read_meta(self.folder).get("samples", {})
        print(f"{self.folder}: whole; {samples.get('kept', 'some')} samples, {samples.get('failed', 0)} failed contacts")
        return 0


@dataclass(frozen=True)
class Show:
    """Write a contact sheet of a set: images over their labels (x y depth, roll pitch yaw)."""

    folder: tyro.conf.Positional[Path]
    """Folder of the set."""
    out: Path = Path("sheet.png")
    """PNG to write."""
    count: int = 24
    """Samples, spread over the set."""
    columns: int = 6
    """Samples in a line."""

    def run(self):
        from sim.sheet import write_sheet

        write_sheet(self.folder, self.out, self.count, self.columns)
        print(f"{self.out} written")
        return 0


@dataclass(frozen=True)
class Dataset:
    """Make, verify and show data sets."""

    action: Annotated[
        Annotated[Make, tyro.conf.subcommand("make")]
        | Annotated[Verify, tyro.conf.subcommand("verify")]
        | Annotated[Show, tyro.conf.subcommand("show")],
        tyro.conf.arg(name=""),
    ]

    def run(self):
        return self.action.run()


@dataclass(frozen=True)
class Stability:
    """Map where contacts converge and where they are refused. Run again, it goes on where it stopped."""

    out: Path = Path("docs")
    """Folder for stability.json, stability.md and stability.png."""
    quick: bool = False
    """Every seventh cell: about a minute and a half on two cores."""
    workers: str = "auto"
    """Worker processes; auto is one a core."""

    def run(self):
        from benchmarks.stability import run
        from sim.crew import worker_count

        result = run(self.out, worker_count(self.workers), self.quick)
        print(f"{self.out / 'stability.md'} written")
        return 1 if result["counts"]["wrong"] else 0


@dataclass(frozen=True)
class Calibrate:
    """Fit the sensor to real frames: lens, pins, materials, friction, rig. Run again, it goes on where it stopped."""

    real: tyro.conf.Positional[Path]
    """Folder of the real set: a neutral image init*.png, frames, targets.csv and meta.json (sim/real_set.py)."""
    design: str = "nominal-127"
    """Design to start from: nominal-127, nominal-331, another preset, or a design file (.json)."""
    out: Path = Path("design.json")
    """Design file to write; --design of other commands takes it."""
    report: Path | None = None
    """Folder for the report; the design file's name with _calibration if not given."""
    frames: int = 60
    """Frames to fit, of one half of the set."""
    judged: int = 150
    """Frames to judge, of the other half."""
    seed: int = 0
    """Seed of the draws of frames."""

    def run(self):
        from dataclasses import replace

        from sim.calibration import Settings, calibrate
        from sim.calibration_report import write_report
        from tactip_model.presets import find_design

        if self.out.suffix != ".json":
            raise TactipError(f"the design file {self.out} must end in .json")
        if self.frames < 10 or self.judged < 10:
            raise TactipError(f"{self.frames} frames to fit and {self.judged} to judge: each must be at least 10")
        report = self.report or self.out.with_name(f"{self.out.stem}_calibration")
        report.mkdir(parents=True, exist_ok=True)
        settings = Settings(frames=self.frames, judged=self.judged, seed=self.seed)
        design = replace(find_design(self.design), name=self.out.stem)
        result = calibrate(self.real, design, settings, report / "state.json")
        figures = write_report(result, self.real.resolve().name, settings, self.out, report)
        judged = figures["frames_px"]["share_of_move_found"]
        print(f"judged frames: {judged['rms']:.2f} px rms, median {judged['median']:.2f} px (256 px image)")
        print(f"{self.out} and {report / 'calibration.md'} written")
        return 0


@dataclass(frozen=True)
class Error:
    """Measure errors and costs of contacts over presets and numbers. Run again, it goes on where it stopped."""

    out: Path = Path("docs")
    """Folder for fidelity.json, fidelity.md and fidelity.png."""
    contacts: int = 10
    """Contacts of each training set for the presets."""
    swept: int = 5
    """Contacts of each training set for numbers changed one at a time."""
    redraw: bool = False
    """Only write page and figure anew from fidelity.json."""

    def run(self):
        from benchmarks.error_against_time import Options, run

        run(Options(contacts=self.contacts, swept=self.swept, out=self.out, redraw=self.redraw))
        print(f"{self.out / 'fidelity.md'} written")
        return 0


@dataclass(frozen=True)
class Parts:
    """Measure what each part of the data-set scene costs, and count what it holds."""

    out: Path = Path("docs")
    """Folder for parts.json and parts.md."""
    contacts: int = 6
    """Contacts of each training set."""

    def run(self):
        from benchmarks.scene_parts import Options, run

        run(Options(contacts=self.contacts, out=self.out))
        print(f"{self.out / 'parts.md'} written")
        return 0


@dataclass(frozen=True)
class Bench:
    """Measure the simulation: its errors, its costs, and where it can be trusted."""

    action: Annotated[
        Annotated[Stability, tyro.conf.subcommand("stability")]
        | Annotated[Error, tyro.conf.subcommand("error")]
        | Annotated[Parts, tyro.conf.subcommand("parts")],
        tyro.conf.arg(name=""),
    ]

    def run(self):
        return self.action.run()


def main(arguments=None):
    """Run the command line. arguments: list of str, the process's own if None. Returns the exit status (int)."""
    about = "A digital twin of the TacTip, a soft optical fingertip."
    command = tyro.extras.subcommand_cli_from_dict(
        {"dataset": Dataset, "calibrate": Calibrate, "bench": Bench}, args=arguments, prog="tactip", description=about
    )
    try:
        return command.run()
    except TactipError as error:
        print(f"tactip: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"tactip: {error.filename or 'a file'}: {error.strerror or error}", file=sys.stderr)
        return 1
    except (Stopped, KeyboardInterrupt) as stopped:
        print(f"tactip: stopped; {stopped or 'nothing was begun'}", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
