"""Pitch and materials from pins of contacts whose poses are unknown, on any tip that a learned tip knows."""

import numpy as np
import pytest

from tactip_twin.learning.pose_from_pins import most_likely
from tactip_twin.learning.tip_from_pins import TipModels, most_likely_tip
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.fast_tip.fast_tip import any_materials, read_fast_tip, shipped_fast_tip
from tactip_twin.tactip_model.neutral_image import neutral_px
from tactip_twin.tactip_model.presets import load_design

COUNT, NOISE_PX = 40, 0.15
DESIGN = load_design("tactip-127")


@pytest.mark.parametrize("task", ["surface", "edge"])
@pytest.mark.parametrize(("where", "log_pitch"), [(0.25, -0.06), pytest.param(0.85, 0.02, marks=pytest.mark.slow)])
def test_tip_and_better_poses_follow_from_pins_alone(task, where, log_pitch):
    models, rng = (
        TipModels(read_fast_tip(any_materials(task)), DESIGN, POSE_RANGES[task], SHEAR_RANGES),
        np.random.default_rng(0),
    )
    materials = models.materials(models.low + where * (models.high - models.low))
    tip = np.append(materials, log_pitch)
    begun, true = models.of(models.middle), models.of(tip)
    truth = true.low + (true.high - true.low) * rng.uniform(0.1, 0.9, (COUNT, len(true.low)))
    pins = true.positions(truth).reshape(COUNT, -1, 2)
    pins += rng.normal(0, NOISE_PX, pins.shape)
    start = most_likely(begun, pins, true.whole(truth), NOISE_PX)
    found = most_likely_tip(models, pins, np.concatenate([start.poses, start.shears], 1), models.middle, NOISE_PX)
    away = np.abs(found - tip) / np.where(models.high > models.low, models.high - models.low, 1.0)
    assert found[-2] == tip[-2]  # the gel's compressibility remains the design's
    assert away[0] < 0.1  # ratio of the moduli
    assert away[1] < 0.15  # friction
    assert abs(found[-1] - log_pitch) < 0.01
    assert models.design(found).pins.pitch_m == pytest.approx(DESIGN.pins.pitch_m * np.exp(log_pitch), rel=0.01)
    after = most_likely(models.of(found), pins, true.whole(truth), NOISE_PX)
    assert after.residuals.mean() == pytest.approx(NOISE_PX * np.sqrt(2), rel=0.1)
    assert start.residuals.mean() > 1.2 * after.residuals.mean()
    errors = [np.abs(one.poses - true.whole(truth)[:, :6])[:, 2].mean() for one in (start, after)]
    assert errors[1] < 0.7 * errors[0]


def test_pins_at_rest_do_not_depend_on_the_pitch():
    models = TipModels(read_fast_tip(any_materials("surface")), DESIGN, POSE_RANGES["surface"], SHEAR_RANGES)
    other = models.design(np.append(models.middle[:-1], -0.2))
    assert other.pins.pitch_m == pytest.approx(np.exp(-0.2) * DESIGN.pins.pitch_m)
    assert np.abs(neutral_px(other) - neutral_px(DESIGN)).max() < 0.02
    assert models.design(models.middle) == DESIGN


def test_tip_of_one_design_has_no_materials_to_find():
    tip = read_fast_tip(shipped_fast_tip("surface", "tactip-127"))
    with pytest.raises(ValueError, match="one design only"):
        TipModels(tip, DESIGN, POSE_RANGES["surface"], SHEAR_RANGES)
