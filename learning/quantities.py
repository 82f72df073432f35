"""Quantities beside the pose that a network can estimate: shear, force and slip, with their columns, units and scales."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from tactip_twin.sim.dataset.format import EFFECTIVE_SHEARS, FORCES, Dataset
from tactip_twin.sim.labels import SHEARS


@dataclass(frozen=True)
class Quantity:
    """A quantity of a contact."""

    name: str
    """Its column in a data set."""
    unit: str
    """Its unit; empty for a fraction."""
    scale: float
    """What its errors are divided by in the loss: about the largest value in the training sets."""


QUANTITIES = (
    *(Quantity(f"shear_{c}", "°" if c == "Rz" else "mm", 5.0) for c in ("x", "y", "Rz")),
    *(Quantity(name, "°" if name.endswith("deg") else "mm", 5.0) for name in EFFECTIVE_SHEARS),
    *(Quantity(name, "N", 3.0) for name in FORCES),
    Quantity("slip_fraction", "", 1.0),
)
"""The commanded shear along the surface, the effective one, the force in the sensor frame, and the fraction of the normal
force that slides. Lloyd & Lepora (IJRR 2024) estimate pose and commanded shear [R]; only a simulation knows the others."""

CONTACT_FORCE_N = 0.05
"""Force on the tip, N, from which on it counts as touching: an image of 128 px does not tell smaller ones from none [M]."""


def quantities_of(dataset: Dataset) -> np.ndarray:
    """Return the QUANTITIES (n, q) of a set's samples; NaN where the set does not have them, as the slip of no contact."""
    shears = dict(zip(SHEARS, dataset.shears.T, strict=True))
    values = np.stack([shears[q.name] if q.name in shears else dataset.measures[q.name] for q in QUANTITIES], 1)
    values[forces_of(values) == 0, -1] = np.nan
    return values


def forces_of(quantities: np.ndarray) -> np.ndarray:
    """Return the magnitudes (n,), N, of the forces in QUANTITIES (n, q)."""
    names = [q.name for q in QUANTITIES]
    return np.linalg.norm(quantities[:, [names.index(name) for name in FORCES]], axis=1)


def contact_probability(forces: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Return the probability (n,) that a force is at least CONTACT_FORCE_N.

    Args:
        forces: (n,) estimated magnitudes, N.
        deviations: (n, 3) standard deviations of the force's components, N.
    """
    return ndtr((forces - CONTACT_FORCE_N) / np.sqrt((deviations**2).mean(1)))
