"""What a network learns of a pose, and in which unit: components by task, each over its greatest value."""

from dataclasses import dataclass, fields

import numpy as np

from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.labels import COMPONENTS, LEARNED
from tactip_twin.tactip_model.errors import TactipError, lookup

_RANGES = tuple(field.name for field in fields(Ranges))
"""Names of a component's range in a configuration, in the order of COMPONENTS."""


@dataclass(frozen=True)
class Labels:
    """The learned components of a task. (k components)"""

    task: str
    """`surface` or `edge`."""
    low: tuple[float, ...]
    """(k) least value of each that was drawn, mm and degrees."""
    high: tuple[float, ...]
    """(k) greatest."""

    @property
    def components(self):
        """Names (tuple of str), of COMPONENTS."""
        return LEARNED[self.task]

    @property
    def names(self):
        """Names (tuple of str) as columns of a data set: pose_z …"""
        return tuple(f"pose_{c}" for c in self.components)

    @property
    def units(self):
        """Units (tuple of str): mm or °."""
        return tuple("°" if c.startswith("R") else "mm" for c in self.components)

    @property
    def scale(self):
        """(k,) float: greatest absolute value; errors are weighted by one over its square [P]."""
        return np.abs([self.low, self.high]).max(0)

    def of(self, poses):
        """The learned components (n, k) of poses (n, 6), mm and degrees."""
        return np.asarray(poses, float)[:, [COMPONENTS.index(c) for c in self.components]]


def labels_of(configuration):
    """The Labels of a data set's configuration (dict, from its meta.json).

    Raises TactipError on a task that is not known, a range that is missing, or one that leaves nothing to learn.
    """
    task = configuration.get("task")
    components = lookup("task", task, LEARNED)
    ranges = configuration.get("pose") or {}
    low, high = [], []
    for component in components:
        name = _RANGES[COMPONENTS.index(component)]
        ends = ranges.get(name)
        good = isinstance(ends, list | tuple) and len(ends) == 2 and all(isinstance(x, int | float) for x in ends)
        numbers = np.array(ends, float) if good else np.zeros(2)
        if not np.isfinite(numbers).all() or not numbers.any():
            raise TactipError(
                f"the set's configuration has {ends} for pose.{name}: it must be two finite numbers, not both 0"
            )
        low.append(float(numbers[0]))
        high.append(float(numbers[1]))
    return Labels(task, tuple(low), tuple(high))
