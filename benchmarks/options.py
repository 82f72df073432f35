"""Options of every measurement, and the table of measurements that `tactip bench` makes its subcommands from.

Nothing heavy is imported here, because the command line reads this module before it knows which command runs.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import tyro

from tactip_twin.sim.labels import FidelityName, Task
from tactip_twin.sim2real.transfer.settings import TransferSettings

ExperimentName = Literal["zero-shot", "ablate", "few-shot", "gap"]
"""Names of the experiments on a real set (sim2real/transfer/experiments.py)."""

ServoGroup = Literal["objects", "oracle", "arm", "fidelity", "robust", "starts"]
"""Groups of servo runs (benchmarks/servo/servo.py)."""

PerformanceGroup = Literal["samples", "growth", "images", "learning", "servo", "faces", "gpu-engine"]
"""Groups of rates (benchmarks/scale/performance.py)."""


@dataclass(frozen=True)
class FidelityOptions:
    """Measure errors and costs of contacts over presets and numbers. Rerun to resume."""

    out: Path = Path("docs")
    """Folder for fidelity.json, fidelity.md and fidelity.png."""
    contacts: int = 10
    """Contacts of each training set for the presets."""
    swept: int = 5
    """Contacts of each training set for numbers changed one at a time."""
    kept: Path = Path("build/fidelity")
    """Folder for the contacts played so far; removed when all is done."""
    redraw: bool = False
    """Only write page and figure anew from fidelity.json."""


@dataclass(frozen=True)
class StabilityOptions:
    """Map where contacts converge and where they are refused. Rerun to resume."""

    out: Path = Path("docs")
    """Folder for stability.json, stability.md and stability.png."""
    quick: bool = False
    """Every seventh cell: about a minute and a half on two cores."""
    workers: str = "auto"
    """Worker processes; auto is one a core."""


@dataclass(frozen=True)
class FrictionOptions:
    """Measure the force along slides, and the dependence of friction on the path."""

    out: Path = Path("docs")
    """Folder for friction.json, friction.md and friction.png."""


@dataclass(frozen=True)
class MaterialsOptions:
    """Compare the materials of gel and skin with closed-form solutions."""

    out: Path = Path("docs")
    """Folder for materials.json and materials.md."""


@dataclass(frozen=True)
class MechanicsOptions:
    """Compare the pressed tip with an independent axisymmetric finite-element code."""

    out: Path = Path("docs")
    """Folder for mechanics.json and mechanics.md."""


@dataclass(frozen=True)
class FemCrossCheckOptions:
    """Compare the pressed gel, on the same tetrahedra, with other finite-element codes."""

    out: Path = Path("docs")
    """Folder for fem_cross_check.json and fem_cross_check.md."""


@dataclass(frozen=True)
class MeshContactOptions:
    """Compare contact models of meshes by error and cost."""

    out: Path = Path("docs")
    """Folder for mesh_contact.json and mesh_contact.md."""


@dataclass(frozen=True)
class SceneCostOptions:
    """Measure what each part of the data-set scene costs, and count what it holds."""

    out: Path = Path("docs")
    """Folder for scene_cost.json and scene_cost.md."""
    contacts: int = 6
    """Contacts of each training set."""


@dataclass(frozen=True)
class LearningOptions:
    """Measure what each step of learning buys, what shear is worth, and error against run time over networks."""

    task: Task = "surface"
    """surface or edge."""
    contacts: int = 2000
    """Contacts to train on in all rows but `laptop-most`: as many as the paper had."""
    most: int = 8000
    """Contacts of that row, whose network is shipped."""
    bent: int = 2000
    """Contacts on bent surfaces, of the row `laptop-bent`."""
    looked: int = 350
    """Contacts with 20 looks each, of the row `laptop-looks`: as long in the making as 2000 contacts of one."""
    judged: int = 2000
    """Sheared contacts each to validate and to test."""
    judged_taps: int = 500
    """Contacts each to validate and to test, of those without shear and of those on bent surfaces."""
    data: Path = Path("data/learning")
    """Folder of the sets: DATA/KIND/TASK/SPLIT."""
    runs: Path = Path("runs/learning")
    """Folder of the trainings: RUNS/TASK/NAME."""
    out: Path = Path("docs")
    """Folder for learning.json, learning.md and learning.png."""
    workers: str = "auto"
    """Worker processes that make sets; auto is one a core."""
    only: tuple[str, ...] = ()
    """Names of the rows to measure; all if there are none. The page keeps the others."""
    paper: bool = False
    """Train the paper's own network, too: for a GPU."""


@dataclass(frozen=True)
class SearchOptions:
    """Run the paper's search with as many trials as there is time for, and write the page that says what was cut."""

    task: Task = "surface"
    """surface or edge."""
    trials: int = 60
    """Trainings in all."""
    jobs: int = 2
    """Trainings at a time."""
    paper: bool = False
    """The paper's whole search: 300 trials, 512 filters; for a GPU."""
    contacts: int = 2000
    """Contacts to train on."""
    judged: int = 2000
    """Contacts to validate on."""
    data: Path = Path("data/learning")
    """Folder of the sets: DATA/plain/TASK/SPLIT."""
    runs: Path = Path("runs/search")
    """Folder of the searches: RUNS/TASK."""
    out: Path = Path("docs")
    """Folder for search.json, search.md and the figures."""
    workers: str = "auto"
    """Worker processes that make sets; auto is one a core."""


@dataclass(frozen=True)
class TransferOptions:
    """Measure what is learned in simulation against real sensors: the experiments of `tactip transfer`, on one page."""

    real: tuple[Path, ...] = ()
    """Folders of imported sets (tactip import)."""
    experiments: tuple[ExperimentName, ...] = ("gap", "zero-shot", "few-shot", "ablate")
    """Which; the page keeps the others."""
    runs: Path = Path("runs/transfer")
    """Folder of sets and networks: RUNS/SET."""
    out: Path = Path("docs")
    """Folder for transfer.json, transfer.md and the figures."""
    workers: str = "auto"
    """Worker processes that make contacts; auto is one a core."""
    settings: Annotated[TransferSettings, tyro.conf.arg(name="")] = field(default_factory=TransferSettings)
    """How the experiments are made."""


@dataclass(frozen=True)
class ReleaseModelsOptions:
    """Copy a network of `tactip bench learning` into the package, with its evaluation and its card."""

    task: Task = "surface"
    """surface or edge."""
    name: str = "laptop-most"
    """Row of `tactip bench learning`."""
    data: Path = Path("data/learning")
    """Its folder of sets."""
    runs: Path = Path("runs/learning")
    """Its folder of trainings."""
    out: Path = Path("assets/models")
    """Folder of the shipped networks."""
    again: bool = False
    """Judge the network that is shipped, and leave its weights as they are."""
    judged: int = 2000
    """Test contacts that it is judged on, then."""
    workers: str = "auto"
    """Worker processes that make them, then; auto is one a core."""


@dataclass(frozen=True)
class MissingNeutralImageOptions:
    """Fit a tip to frames alone, and compare its pins with those of the tip that was fitted to its neutral image."""

    lab: Path
    """Folder of the laboratory's set."""
    real: Path
    """Folder that it was imported into (tactip import)."""
    keep: Path | None = None
    """Folder to keep the set in that is imported without its neutral image: for tactip transfer."""


@dataclass(frozen=True)
class RealComparisonOptions:
    """Compare the simulated 127-pin tip with the real one, in a picture and by the displacements of its pins."""

    out: Path = Path("docs")
    """Folder for real_and_simulated.png."""
    real: Path | None = None
    """Folder with the real neutral frame init_0.png; not needed."""
    fidelity: FidelityName = "standard"
    """draft, standard or reference."""


@dataclass(frozen=True)
class ServoBenchOptions:
    """Measure what the servo reaches: objects, arms, fidelities, what it withstands, random starts."""

    groups: tuple[ServoGroup, ...] = ()
    """objects, oracle, arm, fidelity, robust, starts; all if not given. The page keeps the others."""
    other_surface: str = ""
    """A surface network of another seed, to hold beside the shipped one."""
    other_edge: str = ""
    """An edge network of another seed."""
    runs: Path = Path("runs/servo-bench")
    """Folder of the runs: RUNS/GROUP/NAME."""
    out: Path = Path("docs")
    """Folder for servo.json, servo.md and servo.png."""
    workers: str = "auto"
    """Worker processes; auto is one a core."""


@dataclass(frozen=True)
class PerformanceOptions:
    """Measure rates and memory of data sets, rendering, training, prediction and servo, and how they scale."""

    groups: tuple[PerformanceGroup, ...] = ()
    """Groups to measure. Default: all. The page keeps the last measurement of the others."""
    contacts: int = 40
    """Difference in contacts between the two sets of a rate."""
    steps: int = 60
    """Number of steps of each servo run."""
    out: Path = Path("docs")
    """Folder for performance.json and performance.md."""


@dataclass(frozen=True)
class ScaleOptions:
    """Measure the rates that decide what a large data set costs."""

    contacts: int = 60
    """Contacts of a set that is measured."""
    few: int = 4
    """Contacts of the set that is taken off, for what is paid once."""
    messages: int = 5000
    """Tasks that are handed out to see how many can be."""
    out: Path = Path("docs")
    """Folder for scale.json and scale.md."""


class Measurement(NamedTuple):
    """A subcommand of `tactip bench`."""

    module: str
    """Module whose `run(options)` measures and returns the results (dict)."""
    options: type
    """Dataclass of its options."""
    page: str
    """File that it writes into the folder `options.out`; empty where it writes no page."""


MEASUREMENTS = {
    "fidelity": Measurement("tactip_twin.benchmarks.physics.fidelity", FidelityOptions, "fidelity.md"),
    "stability": Measurement("tactip_twin.benchmarks.physics.stability", StabilityOptions, "stability.md"),
    "friction": Measurement("tactip_twin.benchmarks.physics.friction", FrictionOptions, "friction.md"),
    "materials": Measurement("tactip_twin.benchmarks.physics.materials", MaterialsOptions, "materials.md"),
    "mechanics": Measurement("tactip_twin.benchmarks.physics.mechanics", MechanicsOptions, "mechanics.md"),
    "fem-cross-check": Measurement(
        "tactip_twin.benchmarks.physics.fem_cross_check", FemCrossCheckOptions, "fem_cross_check.md"
    ),
    "mesh-contact": Measurement("tactip_twin.benchmarks.physics.mesh_contact", MeshContactOptions, "mesh_contact.md"),
    "scene-cost": Measurement("tactip_twin.benchmarks.physics.scene_cost", SceneCostOptions, "scene_cost.md"),
    "learning": Measurement("tactip_twin.benchmarks.learning.learning", LearningOptions, "learning.md"),
    "search": Measurement("tactip_twin.benchmarks.learning.search", SearchOptions, "search.md"),
    "transfer": Measurement("tactip_twin.benchmarks.learning.transfer", TransferOptions, "transfer.md"),
    "release-models": Measurement("tactip_twin.benchmarks.learning.release_models", ReleaseModelsOptions, ""),
    "missing-neutral-image": Measurement(
        "tactip_twin.benchmarks.learning.missing_neutral_image", MissingNeutralImageOptions, ""
    ),
    "real-comparison": Measurement(
        "tactip_twin.benchmarks.learning.real_comparison", RealComparisonOptions, "real_and_simulated.png"
    ),
    "servo": Measurement("tactip_twin.benchmarks.servo.servo", ServoBenchOptions, "servo.md"),
    "performance": Measurement("tactip_twin.benchmarks.scale.performance", PerformanceOptions, "performance.md"),
    "scale": Measurement("tactip_twin.benchmarks.scale.scale", ScaleOptions, "scale.md"),
}
"""Measurements by the name of their command, which is also that of their module and page."""
