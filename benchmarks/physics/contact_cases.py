"""Contacts to measure errors on: named cases with fixed poses, and the first ones of the training sets."""

from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, generator
from tactip_twin.sim.labels import COMPONENTS, LEARNED
from tactip_twin.sim.pose import from_mm_deg

NONE = (0.0,) * 6


@dataclass(frozen=True)
class Case:
    """One contact; axes as in sim/pose.py."""

    name: str
    """Name on the page."""
    stimulus: str
    """Name in stimuli.STIMULI."""
    pose_mm_deg: tuple[float, ...] = NONE
    """(6,) label, mm and degrees."""
    shear_mm_deg: tuple[float, ...] = NONE
    """(6,) motion in contact that leads to the pose, mm and degrees."""

    def si(self) -> tuple[np.ndarray, np.ndarray]:
        """Return pose and shear (6,), m and rad."""
        return from_mm_deg(self.pose_mm_deg), from_mm_deg(self.shear_mm_deg)


CASES = (
    Case("flat, normal press", "surface", (0, 0, -3, 0, 0, 0)),
    Case("flat, deep press", "surface", (0, 0, -5, 0, 0, 0)),
    Case("flat, sheared press", "surface", (0, 0, -3, 0, 0, 0), (3, 2, 0, 0, 0, 0)),
    Case("flat, tilted press", "surface", (0, 0, -3, 10, -8, 0)),
    Case("edge, centred", "edge", (0, 0, -3, 0, 0, 0)),
    Case("edge, offset", "edge", (3, 0, -4, 0, 0, 0)),
    Case("edge, yawed", "edge", (-1, 0, -3, 0, 0, 30)),
    Case("edge, yawed and sheared", "edge", (1, 0, -3, 5, -5, 30), (2, -3, 0, 0, 0, 4)),
    Case("sphere, off centre", "sphere", (2, 1, -3, 0, 0, 0)),
    Case("point-like peg", "point", (0, 0, -3, 0, 0, 0)),
)
"""Named cases within the paper's ranges [P]; the sphere has a radius of 5 mm, the peg one of 1 mm."""

CONVERGING = ("flat, normal press", "flat, sheared press", "edge, yawed and sheared", "sphere, off centre")
"""Names of the cases on which the reference itself is refined."""

LABELS = LEARNED | {"sphere": ("x", "y", "z"), "point": ("x", "y", "z")}
"""Components of the pose that a contact determines, by stimulus; names of COMPONENTS."""


def training(task: str, count: int) -> list[Case]:
    """Return the first `count` contacts of a task's training set of seed 0."""
    cases = []
    for index in range(count):
        rng = generator(0, task, "train", index)
        pose, shear = POSE_RANGES[task].sample(rng), SHEAR_RANGES.sample(rng)
        scale = from_mm_deg(np.ones(6))
        cases.append(Case(f"{task} {index}", task, tuple((pose / scale).tolist()), tuple((shear / scale).tolist())))
    return cases


def moved(case: Case, component: str, amount: float) -> Case:
    """Return the case with one component of its pose (a name of COMPONENTS) moved by `amount`, mm or degrees."""
    pose = list(case.pose_mm_deg)
    pose[COMPONENTS.index(component)] += amount
    return Case(f"{case.name}, {component} {amount:+g}", case.stimulus, tuple(pose), case.shear_mm_deg)
