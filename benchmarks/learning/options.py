"""Options of the measurements of networks, learned tips and real sets. Light to import, for the command line."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from tactip_twin.learning.fast_tip_settings import FastTipSettings
from tactip_twin.sim.labels import FidelityName, Task
from tactip_twin.sim2real.transfer.settings import TransferSettings

ExperimentName = Literal["zero-shot", "ablate", "few-shot", "gap"]
"""Names of the experiments on a real set (sim2real/transfer/experiments.py)."""

SearchBudget = Literal["laptop", "gpu", "paper"]
"""Names of the settings of a search (benchmarks/learning/search.py)."""


@dataclass(frozen=True)
class LearningOptions:
    """Measure the benefit of each step of training, of shear, and error against run time of networks. Rerun to resume."""

    task: Task = "surface"
    """Task."""
    contacts: int = 2000
    """Number of training contacts of most rows, as in the paper."""
    large_contacts: int = 8000
    """Number of training contacts of the row `laptop-large`."""
    slides: int = 40
    """Number of sliding paths for validation, and as many for testing, with 15 images each."""
    fast_images: int = 48000
    """Number of training images of the rows `laptop-fast` and `laptop-contact`, whose contacts the learned tip predicts."""
    snapshot_contacts: int = 350
    """Number of training contacts of the row `laptop-snapshots`, with 20 images each."""
    test_contacts: int = 2000
    """Number of sheared contacts for validation, and as many for testing."""
    other_test_contacts: int = 500
    """The same for contacts without shear, and for tests with light contacts."""
    data: Path = Path("data/learning")
    """Folder of the data sets: DATA/KIND/TASK/SPLIT."""
    runs: Path = Path("runs/learning")
    """Folder of the trainings: RUNS/TASK/ROW."""
    out: Path = Path("docs")
    """Folder for learning.json, learning.md and learning.png."""
    workers: str = "auto"
    """Number of worker processes that simulate contacts; auto: one per core."""
    only: tuple[str, ...] = ()
    """Names of the rows to measure; default: all. Other rows of this version remain on the page."""
    paper: bool = False
    """Train the paper's own network, too. It needs a GPU."""


@dataclass(frozen=True)
class UncertaintyOptions:
    """Measure the shipped networks by normal force, their standard deviations, and images unlike those in training."""

    only: tuple[Task, ...] = ()
    """Tasks to measure. Default: all. Results of others remain on the page."""
    data: Path = Path("data/learning")
    """Folder of the data sets of `tactip bench learning`."""
    test_contacts: int = 1000
    """Number of test contacts of each task."""
    light_test_contacts: int = 2000
    """Number of test contacts with light ones."""
    out: Path = Path("docs")
    """Folder for uncertainty.json, uncertainty.md and uncertainty.png."""
    workers: str = "auto"
    """Number of worker processes that simulate contacts; auto: one per core."""


@dataclass(frozen=True)
class ConventionsOptions:
    """Find the conventions of randomly mislabelled sets of hidden sensors. Rerun to resume."""

    copies: int = 20
    """Number of mislabelled copies of each set."""
    frames: int = 150
    """Number of frames of each set."""
    seed: int = 0
    """Seed of the conventions."""
    data: Path = Path("data/conventions")
    """Folder of the sets and of what has been measured."""
    out: Path = Path("docs")
    """Folder for conventions.json and conventions.md."""
    workers: str = "auto"
    """Number of worker processes that simulate contacts; auto: one per core."""


@dataclass(frozen=True)
class SearchOptions:
    """Run the paper's hyperparameter search at a budget, train its best networks in full, and write its page. Rerun to
    resume."""

    task: Task = "surface"
    """Task."""
    budget: SearchBudget = "laptop"
    """Settings of the search: laptop (60 trials of up to 16 filters), gpu (the paper's 300 trials, of up to 128 filters, in
    short trainings; a few minutes on one GPU and a dozen cores) or paper (the paper's whole search)."""
    trials: int | None = None
    """Number of trainings; None: that of the budget."""
    jobs: int = 2
    """Number of simultaneous trainings."""
    page_only: bool = False
    """Only write the page of what has been done so far; make no sets and train nothing. Networks are evaluated if the test
    set is there."""
    contacts: int = 2000
    """Number of training contacts of the search, which the learned tip predicts."""
    long_contacts: int = 5000
    """Number of training contacts of the networks that are trained in full."""
    val_contacts: int = 500
    """Number of validation contacts, which the learned tip predicts."""
    test_contacts: int = 1000
    """Number of test contacts, which are simulated."""
    data: Path = Path("data/search")
    """Folder of the data sets: DATA/TASK/NAME/SPLIT."""
    runs: Path = Path("runs/search")
    """Folder of the searches, RUNS/TASK, and of the long trainings, RUNS/TASK-long."""
    out: Path = Path("docs")
    """Folder for search.json, search.md and the figures."""
    workers: str = "auto"
    """Number of worker processes that simulate contacts; auto: one per core."""


@dataclass(frozen=True)
class TransferOptions:
    """Measure networks trained in simulation on real sensors: the experiments of `tactip transfer` on one page."""

    real: tuple[Path, ...] = ()
    """Folders of imported data sets (tactip import)."""
    experiments: tuple[ExperimentName, ...] = ("gap", "zero-shot", "few-shot", "ablate")
    """Experiments to run; results of others remain on the page."""
    runs: Path = Path("runs/transfer")
    """Folder of the simulated sets and networks: RUNS/SET."""
    out: Path = Path("docs")
    """Folder for transfer.json, transfer.md and the figures."""
    workers: str = "auto"
    """Number of worker processes that simulate contacts; auto: one per core."""
    settings: Annotated[TransferSettings, tyro.conf.arg(name="")] = field(default_factory=TransferSettings)
    """Settings of the experiments."""


@dataclass(frozen=True)
class HiddenSensorsOptions:
    """Measure networks trained in simulation on hidden simulated sensors with rigs that have errors. Rerun to resume."""

    only: tuple[str, ...] = ()
    """Names of the sensors to measure, as on the page; results of others remain. Default: all."""
    frames: int = 400
    """Number of frames of each set; two fifths are for testing."""
    runs: Path = Path("runs/hidden-sensors")
    """Folder of the sets and networks: RUNS/SENSOR."""
    out: Path = Path("docs")
    """Folder for hidden_sensors.json and hidden_sensors.md."""
    workers: str = "auto"
    """Number of worker processes that simulate contacts; auto: one per core."""
    settings: Annotated[TransferSettings, tyro.conf.arg(name="")] = field(default_factory=TransferSettings)
    """Settings of the training in simulation."""


@dataclass(frozen=True)
class ReleaseModelsOptions:
    """Copy a network of `tactip bench learning` into the package, with its evaluation and its card."""

    task: Task = "surface"
    """Task."""
    row: str = "laptop-light"
    """Row of `tactip bench learning`."""
    data: Path = Path("data/learning")
    """Folder of the data sets of `tactip bench learning`."""
    runs: Path = Path("runs/learning")
    """Folder of the trainings of `tactip bench learning`."""
    out: Path = Path("assets/models")
    """Folder of the shipped networks."""
    evaluate_only: bool = False
    """Evaluate the shipped network again, and keep its weights."""
    test_contacts: int = 2000
    """Number of test contacts, made where they are missing."""
    workers: str = "auto"
    """Number of worker processes that simulate these contacts; auto: one per core."""


@dataclass(frozen=True)
class FastTipOptions:
    """Teach the tip that predicts contacts, by number of contacts, and measure its errors and rates. Rerun to resume."""

    task: Task = "surface"
    """Task."""
    contacts: int = 2000
    """Number of training contacts; where the set of `tactip bench learning` is used, its `--large-contacts`."""
    test_contacts: int = 1000
    """Number of contacts for validation, and as many for testing."""
    counts: tuple[int, ...] = ()
    """Numbers of contacts to learn from, besides all."""
    steps: int = FastTipSettings().steps
    """Number of training steps of each network."""
    compared_contacts: int = 24
    """Number of test contacts that are also made at every preset, and corrected."""
    times_only: bool = False
    """Measure only the rates and times of the shipped tip, without sets or training; the rest of the page stays as it is."""
    data: Path = Path("data/learning")
    """Folder of the data sets: DATA/KIND/TASK/SPLIT."""
    runs: Path = Path("runs/fast-tip")
    """Folder of the trainings: RUNS/TASK/COUNT."""
    out: Path = Path("docs")
    """Folder for fast_tip.json and fast_tip.md."""
    release: Path | None = None
    """Folder that the tip which has learned from all contacts is copied to, as TASK-DESIGN.npz. Default: no copy."""
    workers: str = "auto"
    """Number of worker processes that simulate contacts; auto: one per core."""


@dataclass(frozen=True)
class SlidingTipOptions:
    """Teach the tip that predicts how the skin slides; measure its errors on paths and in servo runs. Rerun to resume."""

    task: Task = "surface"
    """Task."""
    paths: int = 800
    """Number of training paths: on surfaces, five eighths of them on curved ones."""
    test_paths: int = 50
    """Number of test paths of each kind."""
    validation_paths: int = 30
    """Number of validation paths of each kind."""
    data: Path = Path("data/slides")
    """Folder of the data sets: DATA/KIND/SPLIT."""
    runs: Path = Path("runs/sliding-tip")
    """Folder of the trainings and of the servo runs: RUNS/TASK."""
    out: Path = Path("docs")
    """Folder for sliding_tip.json and sliding_tip.md."""
    release: Path | None = None
    """Folder that the tip is copied to, as TASK-DESIGN-sliding.npz. Default: no copy."""
    workers: str = "auto"
    """Number of worker processes that simulate paths; auto: one per core."""


@dataclass(frozen=True)
class AnyMaterialsOptions:
    """Teach the tip that knows any materials; measure its errors, and calibrate sensors with it. Rerun to resume."""

    task: Task = "surface"
    """Task."""
    contacts: int = 6000
    """Number of training contacts."""
    test_contacts: int = 500
    """Number of contacts for validation, and as many for testing."""
    steps: int = 30000
    """Number of training steps of each network."""
    width: int = 256
    """Units per layer of the networks."""
    init_from: Path | None = None
    """Learned tip with the initial weights, whose layers replace --width. Default: random weights."""
    real: tuple[Path, ...] = ()
    """Folders of real sets of a 127-pin or 331-pin tip, with the number in their name, to calibrate a nominal design to."""
    seed: int = 0
    """Seed of the selection of frames."""
    data: Path = Path("data/any-materials")
    """Folder of the data sets: DATA/TASK/SPLIT."""
    runs: Path = Path("runs/any-materials")
    """Folder of the training and of the calibrations."""
    out: Path = Path("docs")
    """Folder for any_materials.json and any_materials.md."""
    release: Path | None = None
    """Folder that the tip is copied to, as TASK-any-materials.npz. Default: no copy."""
    workers: str = "auto"
    """Number of worker processes that simulate contacts; auto: one per core."""


@dataclass(frozen=True)
class MissingNeutralImageOptions:
    """Fit a tip to frames alone, and compare its pins with those of the tip that was fitted to its neutral image."""

    lab: Path
    """Folder of the laboratory's set."""
    real: Path
    """Folder that it was imported into (tactip import)."""
    min_depth_mm: float = 0.0
    """Minimum depth of the frames that are used, mm: sets whose contacts are all deep show the pins at rest least."""
    keep: Path | None = None
    """Folder for the set imported without its neutral image, for tactip transfer. Default: it is not kept."""


@dataclass(frozen=True)
class RealComparisonOptions:
    """Compare the displacements of the pins of the simulated 127-pin tip with those of the real one, and plot both."""

    out: Path = Path("docs")
    """Folder for real_and_simulated.png."""
    real: Path | None = None
    """Folder with the real neutral frame init_0.png, to show it. Default: draw the neutral image from measurements."""
    fidelity: FidelityName = "standard"
    """Fidelity of the contact simulation."""
