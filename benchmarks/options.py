"""What may be asked of the longer measurements. Nothing heavy is imported here: the command line reads it to tell what there
is."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tactip_twin.sim2real.transfer.settings import TransferSettings


@dataclass(frozen=True)
class StabilityOptions:
    """Map where contacts converge and where they are refused. Run again, it goes on where it stopped."""

    out: Path = Path("docs")
    """Folder for stability.json, stability.md and stability.png."""
    quick: bool = False
    """Every seventh cell: about a minute and a half on two cores."""
    workers: str = "auto"
    """Worker processes; auto is one a core."""


@dataclass(frozen=True)
class ErrorOptions:
    """Measure errors and costs of contacts over presets and numbers. Run again, it goes on where it stopped."""

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
class PartsOptions:
    """Measure what each part of the data-set scene costs, and count what it holds."""

    out: Path = Path("docs")
    """Folder for parts.json and parts.md."""
    contacts: int = 6
    """Contacts of each training set."""


@dataclass(frozen=True)
class LearningOptions:
    """Measure what each step of learning buys, what shear is worth, and error against run time over networks."""

    task: str = "surface"
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

    task: str = "surface"
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
class TransferredOptions:
    """Measure what is learned in simulation against real sensors: the experiments of `tactip transfer`, on one page."""

    real: tuple[Path, ...] = ()
    """Folders of imported sets (tactip import)."""
    experiments: tuple[str, ...] = ("gap", "zero-shot", "few-shot", "ablate")
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
class FollowedOptions:
    """Measure what the servo reaches: objects, arms, fidelities, what it withstands, random starts."""

    groups: tuple[str, ...] = ()
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
class SpeedOptions:
    """Measure what everything costs, and how it grows: sets, images, training, estimates, servo, objects, start-up."""

    groups: tuple[str, ...] = ()
    """samples, growth, images, learning, servo, faces, threads, gpu-engine, start-up, first-words; all if none is. The page
    keeps the others."""
    contacts: int = 40
    """Contacts that a set is larger by."""
    steps: int = 60
    """Steps of a servo run."""
    out: Path = Path("docs")
    """Folder for performance.json and performance.md."""


@dataclass(frozen=True)
class ScaleOptions:
    """Reckon what a million contacts cost on many machines, from rates measured on this one."""

    contacts: int = 60
    """Contacts of a set that is measured."""
    few: int = 4
    """Contacts of the set that is taken off, for what is paid once."""
    messages: int = 5000
    """Tasks that are handed out to see how many can be."""
    out: Path = Path("docs")
    """Folder for scale.json and scale.md."""


@dataclass(frozen=True)
class ViewerOptions:
    """Measure what a replay costs: host and browser."""

    seconds: float = 10.0
    """How long it plays, s."""
    runs: Path = Path("runs/viewer-bench")
    """Folder of the recording."""
    out: Path = Path("docs")
    """Folder for viewer.json and viewer.md."""
