"""Poses from pins: recovered from the tip's own pins, with errors that match the deviations."""

import numpy as np
import pytest

from tactip_twin.learning.pose_from_pins import PinModel, most_likely
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.fast_tip.fast_tip import PinDecoder, read_fast_tip, shipped_fast_tip
from tactip_twin.tactip_model.presets import load_design

COUNT = 40


@pytest.fixture(scope="module", params=["surface", "edge"])
def case(request):
    """Return the model of a task's pins, and random poses and shears (COUNT, 12), mm and degrees, of firm contacts."""
    task, design = request.param, load_design("tactip-127")
    tip = read_fast_tip(shipped_fast_tip(task, "tactip-127"))
    model = PinModel(tip, PinDecoder(design, tip.modes), POSE_RANGES[task], SHEAR_RANGES)
    rng = np.random.default_rng(0)
    values = model.low + (model.high - model.low) * rng.uniform(0.2, 0.8, (COUNT, len(model.low)))
    whole = model.whole(values)
    whole[:, 2] = rng.uniform(-4.5, -3, COUNT)
    return model, whole, rng


def test_exact_pins_give_the_pose_back(case):
    model, truth, rng = case
    pins = model.positions(truth[:, model.free]).reshape(COUNT, -1, 2)
    start = truth.copy()
    start[:, model.free] += rng.normal(0, 0.3, start[:, model.free].shape)
    found = most_likely(model, pins, start, noise=0.002)
    assert np.median(np.abs(found.poses - truth[:, :6])[:, 2]) < 0.005
    assert np.median(np.abs(found.poses - truth[:, :6])[:, 3:5]) < 0.1
    assert np.median(found.residuals) < 0.005
    assert (found.poses[:, 1] == 0).all()


def test_noisy_pins_err_as_the_deviations_say(case):
    model, truth, rng = case
    pins = model.positions(truth[:, model.free]).reshape(COUNT, -1, 2) + rng.normal(0, 0.03, (COUNT, 127, 2))
    found = most_likely(model, pins, truth, noise=0.03)
    errors = np.concatenate([found.poses, found.shears], 1) - truth
    z = (errors / np.where(model.free, found.deviations, 1.0))[:, [2, 3, 4]]
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.4
    assert found.residuals == pytest.approx(0.03 * np.sqrt(2), rel=0.2)


def test_pins_that_are_confused_hardly_count(case):
    """A tenth of the pins exchanged with their neighbours: the pose is as good as without them."""
    model, truth, rng = case
    pins = model.positions(truth[:, model.free]).reshape(COUNT, -1, 2) + rng.normal(0, 0.01, (COUNT, 127, 2))
    confused = pins.copy()
    confused[:, 1:13:2], confused[:, 2:14:2] = pins[:, 2:14:2], pins[:, 1:13:2]
    errors = [
        np.abs(most_likely(model, one, truth, noise=0.03, outlier=outlier).poses - truth[:, :6])[:, 2:5].mean(0)
        for one, outlier in ((pins, np.inf), (confused, np.inf), (confused, 0.1))
    ]
    assert (errors[1] > 3 * errors[0]).all()
    assert (errors[2] < 1.5 * errors[0] + [0.003, 0.03, 0.03]).all()


def test_deviations_are_larger_for_light_contacts(case):
    model, truth, _ = case
    light = truth.copy()
    light[:, 2] = -1.0
    deviations = [
        np.sqrt(np.diagonal(np.linalg.inv(model.information(model.jacobians(t[:, model.free]), 0.03)), axis1=1, axis2=2))
        for t in (truth, light)
    ]
    names = np.flatnonzero(model.free)
    pitch = int(np.flatnonzero(names == 4)[0])
    assert np.median(deviations[1][:, pitch]) > 2 * np.median(deviations[0][:, pitch])
