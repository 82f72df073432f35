"""Settings of a calibration. Light to import, for the command line."""

from dataclasses import dataclass
from typing import get_args

from tactip_twin.sim2real.importing.column_map import Angles
from tactip_twin.tactip_model.bounds import require


@dataclass(frozen=True)
class FrameSelection:
    """Frames that a calibration uses."""

    fit_frames: int = 40
    """Number of frames to fit, sampled from one half of the set (rows 0, 2, 4 …); at least 10."""
    test_frames: int = 150
    """Number of frames to test the fit on, sampled from the other half (rows 1, 3, 5 …); at least 10."""
    seed: int = 0
    """Seed of the selection of frames."""
    angles: Angles = "vector"
    """Convention of the angles in a table that `tactip protocol` wrote, as --angles was there."""

    def __post_init__(self) -> None:
        require(self.angles in get_args(Angles), "angles", repr(self.angles), ", ".join(get_args(Angles)))


@dataclass(frozen=True)
class Settings(FrameSelection):
    """Settings of a calibration run."""

    rounds: tuple[str, ...] = (*["fast"] * 6, "standard")
    """Fidelity of each round of the fit; `fast` is a learned tip that knows any materials. On the published 127-pin set, the
    sixth of its rounds lowered the cost by less than 0.001 px² [M]."""
    simulated_rounds: tuple[str, ...] = ("draft", "draft", "standard", "standard")
    """Fidelity of each round for a design that the learned tip does not know."""
    test_fidelity: str = "standard"
    """Fidelity of the test."""
