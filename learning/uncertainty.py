"""How good estimated standard deviations are: coverage of intervals, likelihood, and errors by force and by deviation.

With errors e and deviations σ of held-out contacts, z = e / σ should be distributed as a standard normal variable: 68.3 % of
|z| are below 1, 95.4 % below 2, whatever the contact.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.special import ndtri

from tactip_twin.learning.quantities import CONTACT_FORCE_N

FORCE_BANDS_N = (0.0, 0.2, 0.5, 1.0, 2.0, np.inf)
"""Ends of the bands of normal force, N, by which errors are reported."""

LEVELS = (0.5, 0.68, 0.8, 0.9, 0.95, 0.99)
"""Probabilities of intervals about the mean whose coverage is reported."""

REJECTED = (0.1, 0.2, 0.3)
"""Fractions of the least certain estimates that are left out."""


def coverage(errors: np.ndarray, deviations: np.ndarray, level: float) -> np.ndarray:
    """Return the fraction of errors (n, c) inside of the interval of a probability, by component (c); NaN errors do not
    count."""
    inside = np.abs(errors) <= ndtri(0.5 + level / 2) * deviations
    known = np.isfinite(errors)
    return (inside & known).sum(0) / np.maximum(known.sum(0), 1)


def negative_log_likelihood(errors: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Return the mean negative log likelihood of errors (n, c), by component (c), with errors in the components' units."""
    each = 0.5 * (errors / deviations) ** 2 + np.log(deviations) + 0.5 * np.log(2 * np.pi)
    return np.nanmean(each, 0)


def by_force(
    errors: np.ndarray, deviations: np.ndarray, normal_forces: np.ndarray, names: list[str]
) -> list[dict[str, Any]]:
    """Return errors and coverage by band of normal force, as JSON.

    Args:
        errors: (n, c).
        deviations: (n, c).
        normal_forces: (n,) N.
        names: (c) names of the components.
    """
    rows = []
    for low, high in pairwise(FORCE_BANDS_N):
        chosen = (normal_forces >= low) & (normal_forces < high)
        if not chosen.any():
            continue
        some, their = errors[chosen], deviations[chosen]
        values = {
            "mae": np.nanmean(np.abs(some), 0),
            "deviation": their.mean(0),
            "coverage_68": coverage(some, their, 0.68),
            "coverage_95": coverage(some, their, 0.95),
            "nll": negative_log_likelihood(some, their),
        }
        row: dict[str, Any] = {"from_N": low, "to_N": high if np.isfinite(high) else None, "samples": int(chosen.sum())}
        rows.append(row | {key: dict(zip(names, map(float, value), strict=True)) for key, value in values.items()})
    return rows


def band_text(row: Mapping[str, Any]) -> str:
    """Return the band of normal force, N, of a row of `by_force` as text."""
    return f"{row['from_N']:g} to {row['to_N']:g}" if row["to_N"] is not None else f"above {row['from_N']:g}"


def by_rejection(errors: np.ndarray, deviations: np.ndarray, scales: np.ndarray, names: list[str]) -> list[dict[str, Any]]:
    """Return the mean absolute errors of what is kept when the least certain estimates are left out, as JSON.

    Args:
        errors: (n, c).
        deviations: (n, c).
        scales: (c) what deviations are divided by to compare components.
        names: (c) names of the components.
    """
    order = np.argsort(uncertainty(deviations, scales), kind="stable")
    rows = []
    for fraction in (0.0, *REJECTED):
        kept = order[: max(1, round((1 - fraction) * len(order)))]
        mae = np.abs(errors[kept]).mean(0)
        rows.append({"left_out": fraction, "mae": dict(zip(names, map(float, mae), strict=True))})
    return rows


def uncertainty(deviations: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return one number per estimate, (n,): the mean logarithm of its deviations (n, c) over the scales (c)."""
    return np.log(deviations / scales).mean(1)


def reliability(errors: np.ndarray, deviations: np.ndarray, names: list[str]) -> list[dict[str, Any]]:
    """Return the coverage of intervals of LEVELS by component, as JSON: what a reliability diagram shows."""
    return [
        {"level": level, "coverage": dict(zip(names, map(float, coverage(errors, deviations, level)), strict=True))}
        for level in LEVELS
    ]


def contact_figures(probabilities: np.ndarray, forces: np.ndarray) -> dict[str, float]:
    """Return how often contact is missed, and claimed without one, at a probability of one half, as JSON.

    Contacts of less than twice CONTACT_FORCE_N are neither: an image cannot tell on which side of it they are.

    Args:
        probabilities: (n,) estimated probabilities of contact.
        forces: (n,) magnitudes of the true forces, N; NaN where unknown.
    """
    said, touching, free = probabilities >= 0.5, forces >= 2 * CONTACT_FORCE_N, forces == 0
    return {
        "samples_in_contact": int(touching.sum()),
        "samples_without": int(free.sum()),
        "missed_fraction": float((~said[touching]).mean()) if touching.any() else 0.0,
        "false_fraction": float(said[free].mean()) if free.any() else 0.0,
    }
