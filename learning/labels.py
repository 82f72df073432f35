"""Pose components that a network learns, by task, with their units and scales."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.dataset.sampling import MAX_LABEL, Ranges
from tactip_twin.sim.labels import COMPONENTS, LEARNED
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError, lookup

_RANGES = tuple(field.name for field in fields(Ranges))
"""Names of the components' ranges in a configuration, in the order of COMPONENTS."""


_ALL_ROUND_DEG = 300.0
"""Width of a yaw's range above which the network estimates sine and cosine: a number would have to jump by a turn where the
range ends. Up to it, no yaw is near both ends [?]."""


@dataclass(frozen=True)
class Labels:
    """The k learned components of a task."""

    task: str
    """`surface` or `edge`."""
    low: tuple[float, ...]
    """Minimum of each component's range (k), mm and degrees."""
    high: tuple[float, ...]
    """Maximum of each component's range (k), mm and degrees."""

    def __post_init__(self) -> None:
        lookup("task", self.task, LEARNED)
        for name, values in (("low", self.low), ("high", self.high)):
            good = len(values) == len(self.components) and all(
                type(x) in (int, float) and abs(x) <= MAX_LABEL for x in values
            )
            require(good, f"labels.{name}", values, f"{len(self.components)} numbers from -{MAX_LABEL:g} to {MAX_LABEL:g}")
        good = all(low <= high and low**2 + high**2 > 0 for low, high in zip(self.low, self.high, strict=True))
        require(good, "labels", (self.low, self.high), "low at most high, and not both 0")

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the components: a subset of COMPONENTS."""
        return LEARNED[self.task]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of their columns in a data set: pose_z, …"""
        return tuple(f"pose_{c}" for c in self.components)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the components: mm or °."""
        return tuple("°" if c.startswith("R") else "mm" for c in self.components)

    @property
    def scale(self) -> np.ndarray:
        """Maximum absolute values (k,); squared errors are divided by their squares [P]."""
        return np.abs([self.low, self.high]).max(0)

    @property
    def circular(self) -> int | None:
        """Index of the component that comes back to where it began, a yaw all round an edge; None if there is none."""
        for k, (component, low, high) in enumerate(zip(self.components, self.low, self.high, strict=True)):
            if component == "Rz" and high - low > _ALL_ROUND_DEG:
                return k
        return None

    def unwrapped(self, predictions: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Return predictions (n, c), mm and degrees, whose circular component, if there is one, is at most half a turn from
        that of the targets (n, c)."""
        k = self.circular
        if k is None:
            return predictions
        out = predictions.copy()
        out[:, k] -= 360 * np.round((out[:, k] - targets[:, k]) / 360)
        return out

    def of(self, poses: ArrayLike) -> np.ndarray:
        """Return the learned components (n, k) of poses (n, 6), mm and degrees."""
        return np.asarray(poses, float)[:, [COMPONENTS.index(c) for c in self.components]]


def labels_of(configuration: dict[str, Any]) -> Labels:
    """Return the labels of a data set's configuration, from its meta.json.

    Raises:
        TactipError: If the task is unknown, or a range is missing, not finite or zero.
    """
    task: Any = configuration.get("task")
    components = lookup("task", task, LEARNED)
    ranges = configuration.get("pose") or {}
    low, high = [], []
    for component in components:
        name = _RANGES[COMPONENTS.index(component)]
        ends = ranges.get(name)
        good = isinstance(ends, list | tuple) and len(ends) == 2 and all(isinstance(x, int | float) for x in ends)
        numbers = np.array(ends, float) if good else np.zeros(2)
        if not np.isfinite(numbers).all() or not numbers.any():
            raise TactipError(f"pose.{name} in the set's configuration must be two finite numbers, not both 0, got {ends}")
        low.append(float(numbers[0]))
        high.append(float(numbers[1]))
    return Labels(task, tuple(low), tuple(high))
