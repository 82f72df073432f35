"""tactip bench: measurements."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from benchmarks.options import (
    FollowedOptions,
    LearningOptions,
    ScaleOptions,
    SearchOptions,
    SpeedOptions,
    TransferredOptions,
    ViewerOptions,
)


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


class Learning(LearningOptions):
    __doc__ = LearningOptions.__doc__

    def run(self):
        from benchmarks.learned import run

        run(self)
        print(f"{self.out / 'learning.md'} written")
        return 0


class Search(SearchOptions):
    __doc__ = SearchOptions.__doc__

    def run(self):
        from benchmarks.searched import run

        run(self)
        print(f"{self.out / 'search.md'} written")
        return 0


class Followed(FollowedOptions):
    __doc__ = FollowedOptions.__doc__

    def run(self):
        from benchmarks.followed import run

        run(self)
        print(f"{self.out / 'servo.md'} written")
        return 0


class Transferred(TransferredOptions):
    __doc__ = TransferredOptions.__doc__

    def run(self):
        from benchmarks.transferred import run

        run(self)
        print(f"{self.out / 'transfer.md'} written")
        return 0


class Speed(SpeedOptions):
    __doc__ = SpeedOptions.__doc__

    def run(self):
        from benchmarks.speed import run

        run(self)
        print(f"{self.out / 'performance.md'} written")
        return 0


class Scaled(ScaleOptions):
    __doc__ = ScaleOptions.__doc__

    def run(self):
        from benchmarks.scaled import run

        run(self)
        print(f"{self.out / 'scale.md'} written")
        return 0


class Viewed(ViewerOptions):
    __doc__ = ViewerOptions.__doc__

    def run(self):
        from benchmarks.viewed import run

        run(self)
        print(f"{self.out / 'viewer.md'} written")
        return 0


@dataclass(frozen=True)
class Bench:
    """Measure the simulation and what is learned: errors, costs, and where they can be trusted."""

    action: Annotated[
        Annotated[Stability, tyro.conf.subcommand("stability")]
        | Annotated[Error, tyro.conf.subcommand("error")]
        | Annotated[Parts, tyro.conf.subcommand("parts")]
        | Annotated[Learning, tyro.conf.subcommand("learning")]
        | Annotated[Search, tyro.conf.subcommand("search")]
        | Annotated[Followed, tyro.conf.subcommand("servo")]
        | Annotated[Transferred, tyro.conf.subcommand("transfer")]
        | Annotated[Speed, tyro.conf.subcommand("speed")]
        | Annotated[Scaled, tyro.conf.subcommand("scale")]
        | Annotated[Viewed, tyro.conf.subcommand("viewer")],
        tyro.conf.arg(name=""),
    ]
    """What is measured."""

    def run(self):
        return self.action.run()
