"""Ranges and random samples of labelled poses and unlabelled shears, uniform and independent, as in Table 1 of the paper.

Importing this file loads nothing heavier than numpy: the command line takes its options and defaults from here.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tactip_twin.sim.labels import TASKS
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import lookup

Split = Literal["train", "val", "test"]
"""Name of one of the three independent sets of a task."""

MAX_LABEL = 1e6
"""Maximum magnitude of a component of a pose or shear, mm and degrees: larger ones are mistakes."""

SPLITS: tuple[Split, ...] = ("train", "val", "test")
"""The three independent sets of a task. Their order is part of what a seed means."""


_ROUNDING = 1e-9
"""Distance that a label may lie outside its range, because of rounding, mm or degrees."""


@dataclass(frozen=True)
class Ranges:
    """A uniform range (low, high) for each component of a pose or shear; mm and degrees, axes of sim/pose.py."""

    x_mm: tuple[float, float] = (0.0, 0.0)
    """Along x, mm: on edges perpendicular to the edge, positive off the object."""
    y_mm: tuple[float, float] = (0.0, 0.0)
    """Along y, mm: on edges along the edge."""
    depth_mm: tuple[float, float] = (0.0, 0.0)
    """Along the outward normal, mm; negative into the object."""
    roll_deg: tuple[float, float] = (0.0, 0.0)
    """Rotation vector's x component, degrees."""
    pitch_deg: tuple[float, float] = (0.0, 0.0)
    """Rotation vector's y component, degrees."""
    yaw_deg: tuple[float, float] = (0.0, 0.0)
    """Rotation vector's component along the outward normal, degrees."""

    def bounds(self) -> np.ndarray:
        """Return the low and high of each component, (6, 2), mm and degrees."""
        return np.array([self.x_mm, self.y_mm, self.depth_mm, self.roll_deg, self.pitch_deg, self.yaw_deg], float)

    def contain(self, pose: np.ndarray) -> bool:
        """Return whether a pose (6,), m and rad, lies in the ranges, but for rounding."""
        from tactip_twin.sim.pose import to_mm_deg

        low, high = self.bounds().T
        label = to_mm_deg(pose)
        return bool(((label > low - _ROUNDING) & (label < high + _ROUNDING)).all())

    def check(self, name: str) -> None:
        """Raise TactipError if a low is above its high or not finite. name: name of the ranges in messages."""
        for component, (low, high) in vars(self).items():
            possible = max(abs(low), abs(high)) <= MAX_LABEL  # False for NaN
            require(possible, f"{name}.{component}", (low, high), f"two numbers from -{MAX_LABEL:g} to {MAX_LABEL:g}")
            require(low <= high, f"{name}.{component}", (low, high), "a low and a high, with low at most high")

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """Return one uniform sample (6,), m and rad. Every component takes one number of `rng`, fixed or not."""
        from tactip_twin.sim.pose import from_mm_deg

        low, high = self.bounds().T
        return from_mm_deg(low + (high - low) * rng.random(6))


POSE_RANGES = {
    "surface": Ranges(depth_mm=(-5, -1), roll_deg=(-15, 15), pitch_deg=(-15, 15)),
    "edge": Ranges(x_mm=(-5, 5), depth_mm=(-5, -1), roll_deg=(-15, 15), pitch_deg=(-15, 15), yaw_deg=(-45, 45)),
}
"""Labelled poses by task [P, Table 1]."""

SHEAR_RANGES = Ranges(x_mm=(-5, 5), y_mm=(-5, 5), roll_deg=(-5, 5), pitch_deg=(-5, 5), yaw_deg=(-5, 5))
"""Unlabelled perturbations [P, Table 1]."""


def generator(seed: int, task: str, split: str, index: int) -> np.random.Generator:
    """Return the random generator of contact `index`, spawned from the set's seed.

    It does not depend on which worker makes the contact or on which contacts were made before, and is independent over tasks
    and splits. Raises TactipError on an unknown task or split.
    """
    lookup("task", task, dict.fromkeys(TASKS))
    lookup("split", split, dict.fromkeys(SPLITS))
    key = (TASKS.index(task), SPLITS.index(split), index)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


def seed_text(seed: int, task: str, split: str, index: int) -> str:
    """Return the seed of a contact as its rows name it: the arguments of `generator`."""
    return f"{seed}:{task}:{split}:{index}"
