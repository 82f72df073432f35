"""Materials from pins: recovered from contacts whose poses are unknown, on any tip that a learned tip knows."""

import numpy as np
import pytest

from tactip_twin.learning.materials_from_pins import most_likely_materials
from tactip_twin.learning.pose_from_pins import PinModel, most_likely
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.fast_tip.fast_tip import PinDecoder, any_materials, read_fast_tip, shipped_fast_tip
from tactip_twin.tactip_model.presets import load_design

COUNT, NOISE_MM = 40, 0.03
DESIGN = load_design("tactip-127")


def model_of(task):
    """Return the model of the pins of a tip of any materials, those in the middle of their ranges."""
    tip = read_fast_tip(any_materials(task))
    model = PinModel(tip, PinDecoder(DESIGN, tip.modes), POSE_RANGES[task], SHEAR_RANGES)
    return model.with_materials(model.material_ranges.mean(1))


@pytest.mark.parametrize("task", ["surface", "edge"])
@pytest.mark.parametrize("where", [0.25, pytest.param(0.75, marks=pytest.mark.slow)])
def test_materials_and_better_poses_follow_from_pins_alone(task, where):
    model, rng = model_of(task), np.random.default_rng(0)
    low, high = model.material_ranges.T
    materials = low + where * (high - low)
    truth = model.low + (model.high - model.low) * rng.uniform(0.1, 0.9, (COUNT, len(model.low)))
    pins = model.with_materials(materials).positions(truth).reshape(COUNT, -1, 2)
    pins += rng.normal(0, NOISE_MM, pins.shape)
    start = most_likely(model, pins, model.whole(truth), NOISE_MM)
    found = most_likely_materials(model, pins, np.concatenate([start.poses, start.shears], 1), NOISE_MM)
    away = np.abs(found - materials) / (high - low)
    assert away[0] < 0.1  # ratio of the moduli
    assert away[1] < 0.15  # friction
    after = most_likely(model.with_materials(found), pins, model.whole(truth), NOISE_MM)
    assert after.residuals.mean() == pytest.approx(NOISE_MM * np.sqrt(2), rel=0.1)
    assert start.residuals.mean() > 1.2 * after.residuals.mean()
    errors = [np.abs(one.poses - model.whole(truth)[:, :6])[:, 2].mean() for one in (start, after)]
    assert errors[1] < 0.5 * errors[0]


def test_tip_of_one_design_has_no_materials_to_find():
    tip = read_fast_tip(shipped_fast_tip("surface", "tactip-127"))
    model = PinModel(tip, PinDecoder(DESIGN, tip.modes), POSE_RANGES["surface"], SHEAR_RANGES)
    with pytest.raises(ValueError, match="one design only"):
        most_likely_materials(model, np.zeros((1, 127, 2)), np.zeros((1, 12)), NOISE_MM)
