"""Table 1 of the paper: labelled poses and unlabelled perturbations, uniform and independent."""

from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.labels import TASKS
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.errors import TactipError, lookup

SPLITS = ("train", "val", "test")
"""The three independent sets of a task. Their order is part of what a seed means."""


@dataclass(frozen=True)
class Ranges:
    """A uniform range (low, high) for each component of a pose or shear; mm and degrees, axes of sim/pose.py."""

    x_mm: tuple[float, float] = (0.0, 0.0)
    """Horizontal, square to the edge; positive off the object."""
    y_mm: tuple[float, float] = (0.0, 0.0)
    """Horizontal, along the edge."""
    depth_mm: tuple[float, float] = (0.0, 0.0)
    """Along the outward normal; negative into the object."""
    roll_deg: tuple[float, float] = (0.0, 0.0)
    """Rotation vector about x."""
    pitch_deg: tuple[float, float] = (0.0, 0.0)
    """Rotation vector about y."""
    yaw_deg: tuple[float, float] = (0.0, 0.0)
    """Rotation vector about the outward normal."""

    def bounds(self):
        """(6, 2) float: low and high of each component, mm and degrees."""
        return np.array([self.x_mm, self.y_mm, self.depth_mm, self.roll_deg, self.pitch_deg, self.yaw_deg], float)

    def check(self, what):
        """Raise TactipError, naming `what`, where a low is above its high or not a number."""
        for name, (low, high) in vars(self).items():
            if not (np.isfinite(low) and np.isfinite(high)):
                raise TactipError(f"the range {what}.{name} is ({low}, {high}): both ends must be finite numbers")
            if low > high:
                raise TactipError(f"the range {what}.{name} is ({low}, {high}): its low must not be above its high")

    def draw(self, generator):
        """One uniform draw (6,), m and rad, from a numpy Generator. Every component takes one number, fixed or not."""
        low, high = self.bounds().T
        return from_mm_deg(low + (high - low) * generator.random(6))


POSE_RANGES = {
    "surface": Ranges(depth_mm=(-5, -1), roll_deg=(-15, 15), pitch_deg=(-15, 15)),
    "edge": Ranges(x_mm=(-5, 5), depth_mm=(-5, -1), roll_deg=(-15, 15), pitch_deg=(-15, 15), yaw_deg=(-45, 45)),
}
"""Labelled poses by task [P, Table 1]."""

SHEAR_RANGES = Ranges(x_mm=(-5, 5), y_mm=(-5, 5), roll_deg=(-5, 5), pitch_deg=(-5, 5), yaw_deg=(-5, 5))
"""Unlabelled perturbations [P, Table 1]."""


def generator(seed, task, split, index):
    """The numpy Generator of sample `index`, spawned from the set's seed.

    The same whichever worker makes the sample and whichever were made before; independent over tasks and splits.
    Raises TactipError on an unknown task or split.
    """
    lookup("task", task, dict.fromkeys(TASKS))
    lookup("split", split, dict.fromkeys(SPLITS))
    key = (TASKS.index(task), SPLITS.index(split), index)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


def seed_text(seed, task, split, index):
    """The seed (str) of a sample as its row names it: the arguments of `generator`."""
    return f"{seed}:{task}:{split}:{index}"
