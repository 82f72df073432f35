"""Factors on standard deviations, on samples from known distributions."""

import numpy as np
import pytest

from tactip_twin.learning.deviation_scale import DeviationScale, fit_deviation_scale
from tactip_twin.learning.uncertainty import coverage
from tactip_twin.tactip_model.errors import TactipError


def test_fitted_factors_are_the_ratios_by_force():
    """Light contacts are three times, others half as uncertain as estimated."""
    rng, n = np.random.default_rng(0), 20_000
    forces = rng.uniform(0, 4, n)
    estimated = rng.uniform(0.5, 2, (n, 2)) * [1.0, 10.0]
    ratio = np.where(forces < 0.5, 3.0, 0.5)[:, None]
    errors = rng.normal(0, ratio * estimated)
    errors[::3, 1] = np.nan
    scale = fit_deviation_scale(errors, estimated, forces)
    assert scale.at(np.array([0.05, 0.3, 1.5, 9.0])) == pytest.approx(
        np.array([[3, 3], [3, 3], [0.5, 0.5], [0.5, 0.5]]), rel=0.07
    )
    for low, high in ((0.0, 0.4), (1.0, 4.0)):
        band = (forces >= low) & (forces < high)
        scaled = estimated[band] * scale.at(forces[band])
        assert coverage(errors[band], scaled, 0.68) == pytest.approx(0.68, abs=0.03)
        assert coverage(errors[band], scaled, 0.95) == pytest.approx(0.95, abs=0.02)


def test_fitted_factors_without_forces_are_one_row():
    rng = np.random.default_rng(1)
    scale = fit_deviation_scale(rng.normal(0, 2, (5000, 1)), np.ones((5000, 1)), None)
    assert scale.forces_n == (0.0,)
    assert scale.at(np.zeros(3)) == pytest.approx(np.full((3, 1), 2.0), rel=0.05)


def test_fitted_factors_bands_with_few_samples_are_merged():
    rng = np.random.default_rng(2)
    forces = np.concatenate([rng.uniform(0, 0.2, 10), rng.uniform(0.2, 0.5, 200), np.full(5, 3.0)])
    scale = fit_deviation_scale(rng.normal(size=(215, 1)), np.ones((215, 1)), forces)
    assert len(scale.forces_n) == 1
    few = fit_deviation_scale(rng.normal(size=(12, 1)), np.ones((12, 1)), forces[:12])
    assert len(few.forces_n) == 1
    unknown = fit_deviation_scale(np.full((80, 2), np.nan), np.ones((80, 2)), None)
    assert unknown.factors == ((1.0, 1.0),)


@pytest.mark.parametrize(
    ("forces", "factors"),
    [
        ((), ()),
        ((0.5, 0.1), ((1.0,), (1.0,))),
        ((0.1, 0.5), ((1.0,),)),
        ((0.1, 0.5), ((1.0,), (1.0, 1.0))),
        ((0.1,), ((0.0,),)),
        ((0.1,), ((float("nan"),),)),
        ((float("inf"),), ((1.0,),)),
        ((0.1,), (("1",),)),
    ],
)
def test_invalid_scale_is_refused(forces, factors):
    with pytest.raises(TactipError, match="deviation_scale"):
        DeviationScale(forces, factors)


def test_factors_times_others_stay_in_range():
    scale = DeviationScale((0.0, 1.0), ((2.0, 50.0), (1.0, 0.5)))
    assert scale.times(np.array([3.0, 10.0])).factors == ((6.0, 100.0), (3.0, 5.0))
