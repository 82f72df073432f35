"""Options of the measurements of speed. Light to import, for the command line."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

PerformanceGroup = Literal["samples", "images", "learning", "servo", "shared-cores"]
"""Groups of rates (benchmarks/scale/performance.py)."""


@dataclass(frozen=True)
class PerformanceOptions:
    """Measure rates and memory of data sets, rendering, training, prediction and servo, and how they scale."""

    groups: tuple[PerformanceGroup, ...] = ()
    """Groups to measure. Default: all. Results of others remain on the page."""
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
    """Number of contacts that are measured."""
    warm_up_contacts: int = 4
    """Number of contacts of a smaller set, whose time is subtracted because it contains the start."""
    messages: int = 5000
    """Number of empty tasks that are sent to workers."""
    out: Path = Path("docs")
    """Folder for scale.json and scale.md."""
