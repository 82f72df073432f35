"""tactip dataset: make, verify, show and record data sets."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tactip_twin.commands._overrides import with_options
from tactip_twin.commands._pose_reader import reader_of
from tactip_twin.commands._progress import Waiting, to_stderr

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
    """Samples of a set: contacts, or with --symmetric and --looks what is made of them; the paper has 2000."""
    seed: int = 0
    """Seed of the draws."""
    workers: str = "auto"
    """Worker processes; auto is one a core."""
    cluster: str = ""
    """Address of a Ray cluster that makes it, auto for that of this machine, local for one of it alone; OUT is a folder that
    all its machines see. None if empty."""
    fidelity: str = "standard"
    """draft, standard or reference (sim/contact/fidelity.py)."""
    design: str = "tactip-127"
    """tactip-127, tactip-331, or a design file (.json) as `tactip calibrate` writes it."""
    symmetric: bool = False
    """Make samples of each contact's turns and mirrors, too: 8 of a contact on the surface, 2 of one on the edge."""
    curvature_per_m: Range = (0.0, 0.0)
    """Both principal curvatures of the surface, 1/m, drawn from LOW to HIGH for each contact; positive bulges out. Not a
    label."""
    uneven: float = 0.0
    """Share of the contacts, 0 to 1, where they change along the surface, within LOW and HIGH, as about a nose."""
    looks: int = 1
    """Times that each contact is looked at: once where it is pressed and sheared to, and then after each stride of a walk as
    the tip slides on, as in a servo. A look costs less than a contact."""
    mechanics: str = "none"
    """none, or real: stiffness, friction, thickness and pin length of the tip differ from contact to contact
    (sim/dataset/mechanics_randomization.py)."""
    renderer: str = "pyrender"
    """pyrender, or raster: the same image without OpenGL."""
    shard_samples: int = 10_000
    """Samples of a shard: a larger set is a folder of shards, which all commands take as one set."""
    pose: RangeOptions = field(default_factory=RangeOptions)
    """Labelled poses."""
    shear: RangeOptions = field(default_factory=RangeOptions)
    """Unlabelled perturbations."""
    json: bool = False
    """Print a JSON list, an object a set, and nothing else."""

    def run(self):
        from json import dumps

        from tactip_twin.sim.dataset.generate import make
        from tactip_twin.sim.parallel.worker_pool import worker_count

        workers = 0 if self.cluster and self.workers == "auto" else worker_count(self.workers)
        results = make(self._jobs(), workers, to_stderr, self.cluster)
        # A set without a sample is no set that a script should go on with.
        status = 0 if all(r["kept"] for r in results) else 1
        if self.json:
            print(dumps(results))
            return status
        failed = 0
        for r in results:
            failed += r["failed"]
            made = f"{r['made']} tried now" if r["made"] else "complete already"
            print(f"{r['folder']}: {r['kept']} of {r['asked']} samples, {made}; {r['failed']} failed")
        made, seconds = sum(r["made"] for r in results), max(r["seconds"] for r in results)
        if made:
            print(f"{made} samples in {seconds:.1f} s: {made / seconds:.2f} samples/s")
        if failed:
            print(f"{failed} samples failed each try and were left out: meta.json names them and says why")
        return status

    def _jobs(self):
        from tactip_twin.sim.contact.fidelity import fidelity_named
        from tactip_twin.sim.dataset.format import Configuration
        from tactip_twin.sim.dataset.generate import Job
        from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
        from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, SPLITS
        from tactip_twin.sim.labels import TASKS
        from tactip_twin.tactip_model.errors import lookup
        from tactip_twin.tactip_model.presets import find_design

        lookup("task", self.task, dict.fromkeys([*TASKS, "all"]))
        lookup("split", self.split, dict.fromkeys([*SPLITS, "all"]))
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
                    pose=with_options(POSE_RANGES[task], self.pose),
                    shear=with_options(SHEAR_RANGES, self.shear),
                    symmetric=self.symmetric,
                    curvature_per_m=self.curvature_per_m,
                    uneven=self.uneven,
                    shard_samples=self.shard_samples,
                    looks=self.looks,
                    mechanics=lookup("mechanics", self.mechanics, MECHANICS_RANDOMIZATIONS),
                )
                jobs.append(Job(configuration, self.out / task / split if several else self.out))
        return jobs


@dataclass(frozen=True)
class Verify:
    """Check that a set is whole: images, rows, pins, checksums, one configuration."""

    folder: tyro.conf.Positional[Path]
    """Folder of the set."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self):
        from json import dumps

        from tactip_twin.sim.dataset.format import read_meta
        from tactip_twin.sim.dataset.verify import verify

        problems = verify(self.folder)
        if self.json:
            told = {"folder": str(self.folder), "problems": problems, "samples": read_meta(self.folder).get("samples")}
            print(dumps(told))
            return 1 if problems else 0
        for problem in problems:
            print(f"{self.folder}: {problem}", file=sys.stderr)
        if problems:
            print(f"{self.folder}: {len(problems)} problem(s)", file=sys.stderr)
            return 1
        samples = read_meta(self.folder).get("samples", {})
        print(f"{self.folder}: whole; {samples.get('kept', 'some')} samples, {samples.get('failed', 0)} failed")
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
        from tactip_twin.sim.dataset.contact_sheet import write_sheet

        write_sheet(self.folder, self.out, self.count, self.columns)
        print(f"{self.out} written")
        return 0


@dataclass(frozen=True)
class Record:
    """Play a sample's contact once more, the same, and keep every time step: for `tactip replay`."""

    folder: tyro.conf.Positional[Path]
    """Folder of the set."""
    out: Path
    """Folder of the recording."""
    sample: int = 0
    """Index of the sample."""
    model: str = ""
    """A shipped network or the folder of a training, that says what it feels; the shipped one of task and design, if there
    is one and this is empty; `none` for none."""

    def run(self):
        with Waiting("playing the contact"):
            from tactip_twin.sim.dataset.format import read_configuration, read_meta
            from tactip_twin.sim.view.record_contact import record_contact

            configuration = read_configuration(read_meta(self.folder), self.folder)
            read = reader_of(self.model, configuration.task, configuration.design)
            record, _ = record_contact(self.folder, self.sample, self.out, read)
        print(f"{record['object']}: {record['steps']} steps recorded; see them: tactip replay {self.out}")
        return 0


@dataclass(frozen=True)
class Dataset:
    """Make, verify, show and record data sets."""

    action: Annotated[
        Annotated[Make, tyro.conf.subcommand("make")]
        | Annotated[Verify, tyro.conf.subcommand("verify")]
        | Annotated[Show, tyro.conf.subcommand("show")]
        | Annotated[Record, tyro.conf.subcommand("record")],
        tyro.conf.arg(name=""),
    ]
    """What is done."""

    def run(self):
        return self.action.run()
