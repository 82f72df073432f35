"""The contacts that error is measured on: named cases with fixed poses, and the first ones of the training sets."""

from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, generator
from tactip_twin.sim.labels import COMPONENTS, LEARNED
from tactip_twin.sim.pose import from_mm_deg

NONE = (0.0,) * 6


@dataclass(frozen=True)
class Case:
    """One contact; axes of sim/pose.py."""

    name: str
    """Words for the page."""
    stimulus: str
    """Name in stimulus.STIMULI."""
    pose_mm_deg: tuple[float, ...] = NONE
    """Label of the sensor (6,), mm and degrees."""
    shear_mm_deg: tuple[float, ...] = NONE
    """Motion in contact that leads to it (6,), mm and degrees."""

    def si(self):
        """Pose and shear (6,), m and rad."""
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
"""Depths, tilts, offsets and shears of the paper's ranges; the sphere has a radius of 5 mm, the peg one of 1 mm."""

CONVERGING = ("flat, normal press", "flat, sheared press", "edge, yawed and sheared", "sphere, off centre")
"""Cases on which the reference itself is refined."""

LABELS = LEARNED | {"sphere": ("x", "y", "z"), "point": ("x", "y", "z")}
"""Components of the pose (of COMPONENTS) that a contact with a stimulus tells."""


def training(task, count):
    """The first `count` contacts of a task's training set of seed 0: a list of Case."""
    cases = []
    for index in range(count):
        draw = generator(0, task, "train", index)
        pose, shear = POSE_RANGES[task].sample(draw), SHEAR_RANGES.sample(draw)
        scale = from_mm_deg(np.ones(6))
        cases.append(Case(f"{task} {index}", task, tuple((pose / scale).tolist()), tuple((shear / scale).tolist())))
    return cases


def moved(case, component, amount):
    """The Case with a component (name) of its pose moved by `amount`, mm or degrees."""
    pose = list(case.pose_mm_deg)
    pose[COMPONENTS.index(component)] += amount
    return Case(f"{case.name}, {component} {amount:+g}", case.stimulus, tuple(pose), case.shear_mm_deg)
