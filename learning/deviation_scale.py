"""Factors on a network's standard deviations, fitted to the validation set after training.

A network knows its errors on the contacts that it learned from. On others they are larger, in light contacts most of all, so
the factors depend on the estimated force.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import ndtri

from tactip_twin.learning.uncertainty import FORCE_BANDS_N
from tactip_twin.tactip_model.bounds import require

_MIN_SAMPLES = 60
"""Minimum number of validation samples from which the factors of a band of force are fitted [?]."""

_MAX_FACTOR = 100.0
"""Maximum factor, and the inverse of the minimum: others are mistakes."""

_LEVELS = (0.68, 0.95)
"""Probabilities of the intervals whose coverage the factors balance."""


@dataclass(frozen=True)
class DeviationScale:
    """Factors on the standard deviations of c components, by the magnitude of the estimated force."""

    forces_n: tuple[float, ...]
    """(b) forces, N, in ascending order; between them, factors are interpolated."""
    factors: tuple[tuple[float, ...], ...]
    """(b, c) factors."""

    def __post_init__(self) -> None:
        numbers = all(type(x) in (int, float) for row in (self.forces_n, *self.factors) for x in row)
        count = len(self.forces_n)
        good = numbers and count >= 1 and all(0 <= a < b < 1e6 for a, b in pairwise((*self.forces_n, 1e5)))
        require(good, "deviation_scale.forces_n", self.forces_n, "numbers of at least 0 in ascending order")
        good = numbers and len(self.factors) == count and len({len(row) for row in self.factors}) == 1
        good = good and all(1 / _MAX_FACTOR <= x <= _MAX_FACTOR for row in self.factors for x in row)
        allowed = f"as many rows as forces, of numbers from {1 / _MAX_FACTOR:g} to {_MAX_FACTOR:g}"
        require(good, "deviation_scale.factors", self.factors, allowed)

    def at(self, forces_n: np.ndarray) -> np.ndarray:
        """Return the factors (n, c) at forces (n,), N."""
        factors = np.log(self.factors)
        return np.exp(np.stack([np.interp(forces_n, self.forces_n, column) for column in factors.T], 1))

    def times(self, factors: np.ndarray) -> "DeviationScale":
        """Return the factors of each force times others (c), within the allowed range."""
        rows = np.clip(np.array(self.factors) * factors, 1 / _MAX_FACTOR, _MAX_FACTOR)
        return DeviationScale(self.forces_n, tuple(tuple(row) for row in rows.tolist()))


def fit_deviation_scale(errors: np.ndarray, deviations: np.ndarray, forces_n: np.ndarray | None) -> DeviationScale:
    """Return the factors that balance the coverage of the 68 % and the 95 % intervals on held-out samples.

    Args:
        errors: (n, c); NaN where the truth is unknown.
        deviations: (n, c) standard deviations as the network estimates them.
        forces_n: (n,) magnitudes of the estimated forces, N; None if the network estimates none.
    """
    if forces_n is None:
        return DeviationScale((0.0,), (_factors(errors, deviations),))
    groups, waiting = [], np.zeros(len(errors), bool)
    for low, high in pairwise(FORCE_BANDS_N):
        waiting |= (forces_n >= low) & (forces_n < high)
        if waiting.sum() >= _MIN_SAMPLES:
            groups.append(waiting)
            waiting = np.zeros(len(errors), bool)
    if not groups:
        groups, waiting = [np.ones(len(errors), bool)], np.zeros(len(errors), bool)
    groups[-1] = groups[-1] | waiting
    at = tuple(float(np.median(forces_n[group])) for group in groups)
    return DeviationScale(at, tuple(_factors(errors[group], deviations[group]) for group in groups))


def _factors(errors: np.ndarray, deviations: np.ndarray) -> tuple[float, ...]:
    """Return the factor of each component (c): the geometric mean of those that the two intervals need."""
    out = []
    for error, deviation in zip(errors.T, deviations.T, strict=True):
        known = np.isfinite(error)
        if not known.any():
            out.append(1.0)
            continue
        z = np.abs(error[known]) / deviation[known]
        needed = [np.quantile(z, level) / ndtri(0.5 + level / 2) for level in _LEVELS]
        middle = np.sqrt(np.maximum(needed[0] * needed[1], 1e-12))
        out.append(float(np.clip(middle, 1 / _MAX_FACTOR, _MAX_FACTOR)))
    return tuple(out)
