"""tactip dataset: make, verify, show, record and export data sets."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tactip_twin.commands._parsing import Command, Entry, last_value, parse_options, parse_subcommand
from tactip_twin.commands._pose_reader import load_pose_reader
from tactip_twin.commands._progress import DelayedStatus, to_stderr
from tactip_twin.sim.dataset.mechanics_randomization import MechanicsName
from tactip_twin.sim.dataset.object_options import ObjectOptions
from tactip_twin.sim.dataset.options import DatasetOptions
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SPLITS, Split
from tactip_twin.sim.labels import LEARNED_FIDELITIES, TASKS, FidelityName, LearnedFidelityName, Task
from tactip_twin.tactip_model.errors import TactipError

if TYPE_CHECKING:
    from tactip_twin.sim.dataset.generate import Job
    from tactip_twin.sim.dataset.pressed_object import PressedObject
    from tactip_twin.tactip_model.design import Design


@dataclass(frozen=True)
class Make(Command):
    """Make labelled, sheared tactile images with the simulated sensor. Rerun to resume."""

    common = ("out", "task", "split", "options.samples", "workers", "fidelity", "design", "options.seed")
    example = "tactip dataset make --task edge --split all --samples 2000 --out data"

    out: Path
    """Folder of the set. If task or split is `all`, the sets are written to OUT/TASK/SPLIT."""
    task: Task | Literal["all"] = "surface"
    """Stimulus: a flat surface, a straight edge, or both."""
    split: Split | Literal["all"] = "train"
    """Training, validation or test set; they are independent of each other."""
    workers: str = "auto"
    """Number of worker processes; auto: one per core."""
    cluster: str = ""
    """Address of a Ray cluster (auto: this machine's; local: a new one on this machine alone), whose machines must share the
    folder OUT. Default: no cluster."""
    fidelity: FidelityName | LearnedFidelityName = "standard"
    """Fidelity of the simulation (sim/contact/fidelity.py); fast: predict the contacts of standard by a learned tip;
    corrected: predict them, and let the simulation correct them."""
    fast_tip: Path | None = None
    """Learned tip of --fidelity fast or corrected, a file of `tactip fast-tip`; for sliding paths and curved surfaces,
    of `tactip sliding-tip`. Default: the shipped one of task and design."""
    design: str = "tactip-127"
    """Sensor: tactip-127, tactip-331, or a design file (.json) as `tactip calibrate` writes it."""
    size_px: int | None = None
    """Width of the images, px. Default: that of the design, 128."""
    grey: bool = False
    """Keep the grey levels of the images instead of thresholding them."""
    object: Annotated[ObjectOptions, tyro.conf.arg(name="")] = field(default_factory=ObjectOptions)
    """A mesh to press on instead of the flat surface, and where."""
    spread_mm: float = 0.0
    """Radius of the disc about --at-mm in which each contact gets its own place, mm; poses are relative to the surface
    there."""
    randomize_mechanics: MechanicsName = "none"
    """Randomization of the mechanics; with real, stiffness, friction, thickness and pin length of the tip differ from
    contact to contact as between real tips; with wide, the materials differ more, and the pins do not
    (sim/dataset/mechanics_randomization.py)."""
    json: bool = False
    """Print a JSON list with one object per set, and nothing else."""
    options: Annotated[DatasetOptions, tyro.conf.arg(name="")] = field(default_factory=DatasetOptions)
    """Contents of the sets."""

    @classmethod
    def parse(cls, arguments: Sequence[str], prog: str) -> Command:
        """Parse the command line; with --task all once per task, because each task has its own default ranges."""
        named = last_value(arguments, "task")
        if named != "all":
            return parse_options(cls, arguments, prog, cls._with_ranges("edge" if named == "edge" else "surface"))
        makes = [replace(parse_options(cls, arguments, prog, cls._with_ranges(task)), task=task) for task in TASKS]
        return _MakeTasks(tuple(makes))

    @classmethod
    def _with_ranges(cls, task: Task) -> "Make":
        """Return the defaults for a task."""
        return cls(out=tyro.MISSING, options=DatasetOptions(pose=POSE_RANGES[task]))

    def run(self) -> int:
        return self.make_sets(self.jobs())

    def make_sets(self, jobs: list["Job"]) -> int:
        """Make the sets of some jobs. Return the exit status."""
        from json import dumps

        from tactip_twin.sim.dataset.format import read_meta, read_rows
        from tactip_twin.sim.dataset.generate import make
        from tactip_twin.sim.fast_tip.corrected_contacts import MAX_STEPS
        from tactip_twin.sim.parallel.worker_pool import worker_count

        workers = 0 if self.cluster and self.workers == "auto" else worker_count(self.workers)
        results = make(jobs, workers, to_stderr, self.cluster)
        for job, result in zip(jobs, results, strict=True):
            if job.fast_tip:
                rows = read_rows(job.folder, read_meta(job.folder))
                longest = MAX_STEPS if job.configuration.corrected else 0
                result["simulated"] = sum(int(row["steps"]) > longest for row in rows)
        # For a script, an empty set is a failure.
        status = 0 if all(r["kept"] for r in results) else 1
        if self.json:
            print(dumps(results))
            return status
        failed = 0
        for r in results:
            failed += r["failed"]
            made = f"{r['made']} made now" if r["made"] else "complete already"
            print(f"{r['folder']}: {r['kept']} of {r['asked']} samples, {made}; {r['failed']} failed")
            if r.get("simulated"):
                print(f"{r['simulated']} of them were simulated, because their prediction could not be trusted")
        made, seconds = sum(r["made"] for r in results), max(r["seconds"] for r in results)
        if made:
            print(f"{made} samples in {seconds:.1f} s: {made / seconds:.2f} samples/s")
        if failed:
            print(f"{failed} samples failed all attempts and were left out; meta.json lists them with the reasons")
        return status

    def jobs(self, several: bool = False) -> list["Job"]:
        """Return the sets to make.

        Args:
            several: Whether the sets go into OUT/TASK/SPLIT although only one task and split is named.
        """
        from tactip_twin.sim.contact.fidelity import fidelity_named
        from tactip_twin.sim.dataset.configuration import Configuration
        from tactip_twin.sim.dataset.generate import Job
        from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS

        several = several or self.split == "all"
        design, tip, digest = self._design(), None, ""
        learns = self.fidelity in LEARNED_FIDELITIES
        if learns:
            tip, digest = self._learned_tip(design)
        elif self.fast_tip:
            raise TactipError(f"--fast-tip is for --fidelity fast or corrected, got --fidelity {self.fidelity}")
        data, pressed = self._pressed_object()
        jobs = []
        for split in SPLITS if self.split == "all" else (self.split,):
            configuration = Configuration(
                task=self.task,
                split=split,
                **vars(self.options),
                design=design,
                fidelity=fidelity_named("standard" if learns else self.fidelity),
                fast_tip=digest,
                corrected=self.fidelity == "corrected",
                object=pressed,
                mechanics_randomization=MECHANICS_RANDOMIZATIONS[self.randomize_mechanics],
            )
            jobs.append(Job(configuration, self.out / self.task / split if several else self.out, tip, data))
        return jobs

    def _pressed_object(self) -> "tuple[bytes | None, PressedObject | None]":
        """Return the content of object.npz and the record of the object; None without one."""
        from numpy.random import default_rng

        from tactip_twin.sim.dataset.format import checksum
        from tactip_twin.sim.dataset.pressed_object import PressedObject, PressPlaces, pack_object

        if not self.object.object:
            if self.object != ObjectOptions() or self.spread_mm:
                raise TactipError("--unit, --scale, --rotation-deg, --at-mm and --spread-mm need an --object")
            return None, None
        solid = self.object.solid((lambda text: None) if self.json else print)
        data = pack_object(solid)
        chosen = PressedObject(Path(self.object.object).stem, checksum(data), self.object.at_mm, self.spread_mm)
        PressPlaces(chosen, solid).sample(default_rng(0))  # a place beside the object fails before anything is written
        return data, chosen

    def _design(self) -> "Design":
        """Return the design with the options' kind of image."""
        from tactip_twin.tactip_model.presets import load_design

        design = load_design(self.design)
        size_px = design.image.size_px if self.size_px is None else self.size_px
        return replace(design, image=replace(design.image, size_px=size_px, grey=self.grey or design.image.grey))

    def _learned_tip(self, design: "Design") -> tuple[Path, str]:
        """Return file and checksum of the learned tip."""
        from tactip_twin.sim.fast_tip.fast_tip import read_fast_tip, shipped_fast_tip
        from tactip_twin.sim.fast_tip.sliding_tip import read_sliding_tip, shipped_sliding_tip

        task: Task = "edge" if self.task == "edge" else "surface"
        o = self.options
        slides = o.snapshots_per_contact > 1 or any(o.curvature_per_m) or o.rough_fraction > 0
        randomized = self.randomize_mechanics != "none"
        if slides:
            path = self.fast_tip or shipped_sliding_tip(task, design.name)
            tip = read_sliding_tip(path)
            tip.check_design(design)
        else:
            path = self.fast_tip or shipped_fast_tip(task, design.name, randomized)
            tip = read_fast_tip(path)
            tip.check_design(design, randomized)
        if tip.task != task:
            raise TactipError(f"the learned tip in {path} is for {tip.task}, got --task {task}")
        return path, tip.digest


@dataclass(frozen=True)
class _MakeTasks(Command):
    """`tactip dataset make --task all`."""

    makes: tuple[Make, ...]
    """The options for each of TASKS."""

    def run(self) -> int:
        return self.makes[0].make_sets([job for make in self.makes for job in make.jobs(several=True)])


@dataclass(frozen=True)
class Verify(Command):
    """Check that a set is complete and undamaged: images, rows, pins, checksums, configuration."""

    example = "tactip dataset verify data/surface/train"

    folder: tyro.conf.Positional[Path]
    """Folder of the set."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> int:
        from json import dumps

        from tactip_twin.sim.dataset.format import read_meta
        from tactip_twin.sim.dataset.verify import verify

        problems = verify(self.folder)
        samples = None if problems else read_meta(self.folder)["samples"]
        if self.json:
            print(dumps({"folder": str(self.folder), "problems": problems, "samples": samples}))
            return 1 if problems else 0
        for problem in problems:
            print(f"{self.folder}: {problem}", file=sys.stderr)
        if samples is None:
            print(f"{self.folder}: {len(problems)} problem(s)", file=sys.stderr)
            return 1
        print(f"{self.folder}: complete; {samples['kept']} samples, {samples['failed']} failed")
        return 0


@dataclass(frozen=True)
class Show(Command):
    """Write a contact sheet of a set: tactile images above their labels."""

    example = "tactip dataset show data/surface/train --out sheet.png"

    folder: tyro.conf.Positional[Path]
    """Folder of the set."""
    out: Path = Path("sheet.png")
    """PNG file to write."""
    count: int = 24
    """Number of samples, evenly spaced in the set."""
    columns: int = 6
    """Number of samples per row."""

    def run(self) -> int:
        from tactip_twin.sim.dataset.contact_sheet import write_sheet

        write_sheet(self.folder, self.out, self.count, self.columns)
        print(f"{self.out} written")
        return 0


@dataclass(frozen=True)
class Record(Command):
    """Simulate the contact of a sample again and record every time step, for `tactip replay`."""

    example = "tactip dataset record data/edge/train --sample 7 --out runs/contact"

    folder: tyro.conf.Positional[Path]
    """Folder of the set."""
    out: Path
    """Folder of the recording."""
    sample: int = 0
    """Index of the sample."""
    model: str = ""
    """Shipped network, or folder of a training. Default: the shipped network of task and design, if there is one; none: no
    prediction."""

    def run(self) -> int:
        with DelayedStatus("simulating the contact"):
            from tactip_twin.sim.dataset.format import read_configuration, read_meta
            from tactip_twin.sim.view.record_contact import record_contact

            configuration = read_configuration(read_meta(self.folder), self.folder)
            read = load_pose_reader(self.model, configuration.task, configuration.design)
            record, _ = record_contact(self.folder, self.sample, self.out, read)
        print(f"{record['object']}: {record['steps']} steps recorded; tactip replay {self.out} shows them")
        return 0


@dataclass(frozen=True)
class Export(Command):
    """Write a set or a servo run in the format of LeRobot, with images as images, pins and forces. Needs the extra
    `lerobot`."""

    example = "tactip dataset export runs/servo-bust --lerobot lerobot/servo-bust"

    folder: tyro.conf.Positional[Path]
    """Folder of a set, of a servo run, or of a recorded contact."""
    lerobot: Path
    """Folder to write, a LeRobot data set of version 3.0; it must not exist."""
    fps: int = 10
    """Frames per second that the format states: contacts and steps of a servo have no rate of their own."""

    def run(self) -> int:
        with DelayedStatus("reading the set or the run"):
            from tactip_twin.sim.lerobot.export import export_lerobot

        episodes, frames = export_lerobot(self.folder, self.lerobot, self.fps)
        print(f"{self.lerobot} written: {frames} frames in {episodes} episodes")
        return 0


@dataclass(frozen=True)
class Import(Command):
    """Write the set or the servo run that `tactip dataset export` wrote in the format of LeRobot. Needs the extra
    `lerobot`."""

    example = "tactip dataset import lerobot/servo-bust --out runs/servo-bust"

    folder: tyro.conf.Positional[Path]
    """Folder of a LeRobot data set that `tactip dataset export` wrote."""
    out: Path
    """Folder to write; it must not exist."""

    def run(self) -> int:
        with DelayedStatus("reading the LeRobot data set"):
            from tactip_twin.sim.lerobot.restore import restore

        frames = restore(self.folder, self.out)
        print(f"{self.out} written: {frames} samples or steps")
        return 0


class Dataset(Command):
    """Make, verify, show, record and export data sets."""

    @classmethod
    def parse(cls, arguments: Sequence[str], prog: str) -> Command:
        """Parse the options of the named action."""
        actions = {"make": Make, "verify": Verify, "show": Show, "record": Record, "export": Export, "import": Import}
        table = {name: Entry(action.__doc__ or "", action.parse) for name, action in actions.items()}
        return parse_subcommand(table, arguments, prog, cls.__doc__ or "")
