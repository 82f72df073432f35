"""Settings of a calibration. Light to import."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """How a calibration is run."""

    frames: int = 60
    """Frames to fit, sampled from the first half of the set (rows 0, 2, 4 …)."""
    judged: int = 150
    """Frames to test on, sampled from the other half (rows 1, 3, 5 …)."""
    rounds: tuple[str, ...] = ("draft", "draft", "standard", "standard")
    """Fidelity of each round of the fit."""
    judging: str = "standard"
    """Fidelity of the test."""
    seed: int = 0
    """Seed of the choice of frames."""
