"""Materials of a sensor, estimated from its frames: those of the tip that made them, as far as pins show them."""

from dataclasses import replace

import numpy as np
import pytest

from tactip_twin.learning.pose_from_pins import PinModel
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.fast_tip.fast_tip import PinDecoder, any_materials, read_fast_tip
from tactip_twin.sim.fast_tip.materials import INPUTS, are_learned, material_inputs
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.transfer.estimated_materials import with_estimated_materials
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

DESIGN = design_named("nominal-127")
TIP = read_fast_tip(any_materials("surface"))
AROUND = MECHANICS_RANDOMIZATIONS["estimated"]


def frames_of(design, count=60):
    """Return tactile images of random presses of a tip with a design, as the learned tip predicts them."""
    decoder, rng = PinDecoder(design, TIP.modes), np.random.default_rng(1)
    model = PinModel(TIP, decoder, POSE_RANGES["surface"], SHEAR_RANGES)
    values = model.low + (model.high - model.low) * rng.uniform(0.1, 0.9, (count, len(model.low)))
    contacts = from_mm_deg(model.whole(values).reshape(-1, 2, 6))
    found = TIP.predict(decoder, contacts[:, 0], contacts[:, 1], material_inputs(design.materials))
    raster = Raster(design)
    frames = (raster.render(tips, towards) for tips, towards in zip(found.pin_tips, found.directions, strict=True))
    return np.stack([tactile_image(frame, design.image) for frame in frames])


@pytest.mark.parametrize(("friction", "stiffness"), [(0.5, 1.4), pytest.param(0.9, 0.6, marks=pytest.mark.slow)])
def test_materials_are_those_that_made_the_frames(friction, stiffness):
    m = DESIGN.materials
    true = replace(m, friction=friction, skin_young_pa=stiffness * m.skin_young_pa, kinetic_fraction=0.75)
    frames = frames_of(replace(DESIGN, materials=true))
    start = replace(DESIGN, materials=replace(m, kinetic_fraction=0.63))
    design, found = with_estimated_materials(start, frames, "surface", AROUND)
    assert np.allclose([found[name] for name in INPUTS], material_inputs(design.materials))
    assert found["after_px"] < found["before_px"]
    assert design.materials.gel_young_pa == m.gel_young_pa
    assert abs(np.log(design.materials.skin_young_pa / true.skin_young_pa)) < 0.25
    # Static friction and the fraction that is left of it in sliding can stand in for each other.
    assert 0.7 < design.materials.friction / friction < 1.4
    # Whatever is drawn around them, the learned tip knows it.
    rng = np.random.default_rng(0)
    drawn = [material_inputs(AROUND.sample(design, rng).materials) for _ in range(100)]
    assert all(are_learned(inputs, TIP.materials).all() for inputs in drawn)


def test_frames_without_pins_show_no_materials():
    with pytest.raises(TactipError, match="contacts cannot be estimated: 90% of the pins were detected in 0 of 20 frames"):
        with_estimated_materials(DESIGN, np.zeros((20, 128, 128), np.uint8), "surface", AROUND)
