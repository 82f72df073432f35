"""Pitch and materials of a sensor, estimated from its frames: those of the tip that made them, as far as pins show them."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.predicted_frames import TIP, blobs_in, frames_of
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.fast_tip.materials import INPUTS, are_learned, material_inputs
from tactip_twin.sim2real.transfer.estimated_mechanics import estimated_mechanics
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import with_spacing
from tactip_twin.tactip_model.presets import design_named

DESIGN = design_named("nominal-127")
AROUND = MECHANICS_RANDOMIZATIONS["estimated"]


@pytest.mark.parametrize(
    ("friction", "stiffness", "wider"), [(0.9, 0.6, 0.93), pytest.param(0.5, 1.4, 1.0, marks=pytest.mark.slow)]
)
def test_mechanics_are_those_that_made_the_frames(friction, stiffness, wider):
    m = DESIGN.materials
    true = replace(m, friction=friction, skin_young_pa=stiffness * m.skin_young_pa, kinetic_fraction=0.75)
    frames = frames_of(replace(with_spacing(DESIGN, wider), materials=true))
    start = replace(DESIGN, materials=replace(m, kinetic_fraction=0.63))
    with_pitch, design, found = estimated_mechanics(start, blobs_in(frames), "surface", AROUND)
    assert np.allclose([found[name] for name in INPUTS], material_inputs(design.materials))
    assert with_pitch.pins == design.pins and with_pitch.materials == start.materials
    assert design.pins.pitch_m / DESIGN.pins.pitch_m == pytest.approx(wider, abs=0.015)
    assert found["after_px"] < found["before_px"]
    assert design.materials.gel_young_pa == m.gel_young_pa
    assert abs(np.log(design.materials.skin_young_pa / true.skin_young_pa)) < 0.25
    # Static friction and the fraction that is left of it in sliding can stand in for each other.
    assert 0.7 < design.materials.friction / friction < 1.4
    # Whatever is drawn around them, the learned tip knows it.
    rng = np.random.default_rng(0)
    drawn = [material_inputs(AROUND.sample(design, rng).materials) for _ in range(100)]
    assert all(are_learned(inputs, TIP.materials).all() for inputs in drawn)


def test_frames_without_pins_show_no_mechanics():
    with pytest.raises(TactipError, match="contacts cannot be estimated: 90% of the pins were detected in 0 of 20 frames"):
        estimated_mechanics(DESIGN, [np.zeros((0, 2))] * 20, "surface", AROUND)
