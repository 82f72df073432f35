"""Curves of a recording over its steps: force, estimated and true components, and the error of the estimated position."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.labels import COMPONENTS, LEARNED
from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.sim.robot.recording import PHASES

BAND = 2.0
"""Half width of the band about the estimates, in standard deviations: it contains 95 % of the true values."""

MIN_CONTACT_N = 0.02
"""Force above which there is contact, N."""

COMPONENT_NAMES = {"x": "x", "y": "y", "z": "depth", "Rx": "Rx", "Ry": "Ry", "Rz": "Rz"}
"""Names on a page of the components of a label."""


@dataclass(frozen=True)
class Curve:
    """One quantity over the n steps of a recording."""

    name: str
    """What it is."""
    unit: str
    """Its unit."""
    true: np.ndarray
    """(n,) true values; of a curve without estimates, its values."""
    estimated: np.ndarray | None = None
    """(n,) estimated values; NaN where there is no contact. None if it is not estimated."""
    deviations: np.ndarray | None = None
    """(n,) standard deviations of the estimates; None if there are none."""

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest value where there is contact, with a margin."""
        shown = self.true if self.estimated is None else self.true[np.isfinite(self.estimated)]
        ends = [shown, [] if self.estimated is None else self.estimated]
        if self.deviations is not None and self.estimated is not None:
            ends += [self.estimated + BAND * self.deviations, self.estimated - BAND * self.deviations]
        values = np.concatenate(ends)
        values = values[np.isfinite(values)]
        if not len(values):
            return -1.0, 1.0
        low, high = (float(x) for x in np.percentile(values, [0.5, 99.5]))
        margin = max(0.08 * (high - low), 0.01)
        return low - margin, high + margin


def in_contact(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return at which steps (n,) bool of a recording estimates mean something: neither searching nor without force."""
    force = np.linalg.norm(arrays["force_n"], axis=1)
    return (arrays["phase"] != PHASES.index("search")) & (force > MIN_CONTACT_N)


def _estimated(arrays: Mapping[str, np.ndarray], task: str) -> tuple[str, ...]:
    """Return the components that a recording's estimates have: those of the task, and others that are not zero, such as the
    shear while a moving object is tracked."""
    others = np.count_nonzero(np.nan_to_num(arrays["predicted"]), axis=0)
    return tuple(c for k, c in enumerate(COMPONENTS) if c in LEARNED[task] or others[k])


def position_errors_mm(arrays: Mapping[str, np.ndarray], task: str) -> np.ndarray:
    """Return the distances (n,), mm, of the estimated from the true contact along the estimated translations."""
    rows = [k for k, name in enumerate(COMPONENTS[:3]) if name in _estimated(arrays, task)]
    difference = 1e3 * (arrays["predicted"] - arrays["true"])[:, rows]
    return np.where(in_contact(arrays), np.linalg.norm(difference, axis=1), np.nan)


def curves_of(arrays: Mapping[str, np.ndarray], task: str) -> list[Curve]:
    """Return the curves of a recording (tactip_twin.sim.robot.recording.ARRAYS) of a task."""
    contact = in_contact(arrays)
    true, predicted, deviations = (to_mm_deg(arrays[name]) for name in ("true", "predicted", "deviations"))
    out = [Curve("force", "N", np.linalg.norm(arrays["force_n"], axis=1))]
    out += [Curve("position error", "mm", position_errors_mm(arrays, task))]
    shown = _estimated(arrays, task)
    for component, name in COMPONENT_NAMES.items():
        if component in shown:
            k, unit = COMPONENTS.index(component), "°" if component.startswith("R") else "mm"
            estimated = np.where(contact, predicted[:, k], np.nan)
            spread = np.where(contact, deviations[:, k], np.nan)
            out.append(Curve(name, unit, true[:, k], estimated, spread if np.isfinite(spread).any() else None))
    return out
