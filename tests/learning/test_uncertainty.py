"""Measures of standard deviations, on samples from known distributions."""

import numpy as np
import pytest

from tactip_twin.learning.uncertainty import (
    LEVELS,
    by_force,
    by_rejection,
    contact_figures,
    coverage,
    negative_log_likelihood,
    reliability,
    uncertainty,
)

N = 40_000
NAMES = ["pose_z", "pose_Rx"]


def sampled(seed=0):
    """Return errors and their true deviations (N, 2)."""
    rng = np.random.default_rng(seed)
    deviations = rng.uniform(0.1, 3, (N, 1)) * [0.1, 1.0]
    return rng.normal(0, deviations), deviations


@pytest.mark.parametrize("level", LEVELS)
def test_coverage_of_true_deviations_is_the_level(level):
    errors, deviations = sampled()
    assert coverage(errors, deviations, level) == pytest.approx(level, abs=0.01)
    assert (coverage(errors, 0.5 * deviations, level) < level - 0.005).all()


def test_coverage_leaves_out_unknown_errors():
    errors, deviations = sampled()
    errors[::2, 0] = np.nan
    assert coverage(errors, deviations, 0.68) == pytest.approx(0.68, abs=0.015)


def test_negative_log_likelihood_is_least_for_true_deviations():
    """For these it is the entropy, 1/2 + log(2π)/2 + E[log σ]."""
    errors, deviations = sampled()
    best = negative_log_likelihood(errors, deviations)
    assert best == pytest.approx(0.5 + 0.5 * np.log(2 * np.pi) + np.log(deviations).mean(0), abs=0.02)
    assert (negative_log_likelihood(errors, 1.3 * deviations) > best).all()
    assert (negative_log_likelihood(errors, deviations / 1.3) > best).all()
    assert (negative_log_likelihood(errors, np.broadcast_to(deviations.mean(0), errors.shape)) > best).all()


def test_by_force_has_errors_and_coverage_of_each_band():
    rng = np.random.default_rng(1)
    forces = rng.uniform(0, 3, N)
    deviations = np.where(forces < 0.5, 2.0, 0.5)[:, None] * [0.1, 1.0]
    rows = by_force(rng.normal(0, deviations), deviations, forces, NAMES)
    assert [(r["from_N"], r["to_N"]) for r in rows] == [(0.0, 0.2), (0.2, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, None)]
    assert sum(r["samples"] for r in rows) == N
    for row in rows:
        expected = 0.8 * (2.0 if row["from_N"] < 0.5 else 0.5)
        assert row["mae"]["pose_Rx"] == pytest.approx(expected, rel=0.05)
        assert row["coverage_68"]["pose_z"] == pytest.approx(0.68, abs=0.03)
        assert row["coverage_95"]["pose_Rx"] == pytest.approx(0.95, abs=0.02)


def test_by_rejection_keeps_the_most_certain():
    errors, deviations = sampled()
    rows = by_rejection(errors, deviations, np.array([0.1, 1.0]), NAMES)
    maes = [row["mae"]["pose_z"] for row in rows]
    assert [row["left_out"] for row in rows] == [0.0, 0.1, 0.2, 0.3]
    assert maes == sorted(maes, reverse=True)
    assert maes[0] == pytest.approx(np.abs(errors[:, 0]).mean())
    kept = deviations[:, 0] <= np.quantile(deviations[:, 0], 0.7)
    assert maes[-1] == pytest.approx(np.abs(errors[kept, 0]).mean(), rel=0.01)


def test_uncertainty_does_not_depend_on_units():
    _, deviations = sampled()
    scales = np.array([5.0, 15.0])
    assert np.allclose(uncertainty(deviations, scales), uncertainty(1000 * deviations, 1000 * scales))


def test_reliability_has_every_level():
    rows = reliability(*sampled(), NAMES)
    assert [row["level"] for row in rows] == list(LEVELS)
    assert all(row["coverage"]["pose_z"] == pytest.approx(row["level"], abs=0.01) for row in rows)


def test_contact_figures_count_both_kinds_of_mistakes():
    """Contacts between none and 0.1 N do not count."""
    forces = np.array([1, 0.2, 3, 0.1, 0, 0, 0.04, 0.09, np.nan])
    figures = contact_figures(np.array([0.9, 0.8, 0.7, 0.2, 0.1, 0.6, 0.5, 0.1, 0.9]), forces)
    assert figures == {"samples_in_contact": 4, "samples_without": 2, "missed_fraction": 0.25, "false_fraction": 0.5}
