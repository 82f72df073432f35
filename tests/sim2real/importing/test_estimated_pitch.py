"""Pitch of the pins of a sensor, estimated from its frames."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.predicted_frames import blobs_in, frames_of
from tactip_twin.sim2real.importing.estimated_pitch import lowest, with_estimated_pitch
from tactip_twin.tactip_model.neutral_image import neutral_px, widest_spacing, with_spacing
from tactip_twin.tactip_model.pins import plan_positions
from tactip_twin.tactip_model.presets import DESIGNS, design_named
from tactip_twin.tactip_model.sensor_of_image import free_sensor

DESIGN = design_named("nominal-127")


@pytest.mark.parametrize("factor", [0.93, pytest.param(1.03, marks=pytest.mark.slow)])
def test_pitch_is_that_of_the_pins_that_made_the_frames(factor):
    """The frames' tip has other materials, too."""
    materials = replace(DESIGN.materials, friction=0.8, skin_young_pa=1.3 * DESIGN.materials.skin_young_pa)
    frames = frames_of(replace(with_spacing(DESIGN, factor), materials=materials), 30)
    design, apart_px = with_estimated_pitch(DESIGN, blobs_in(frames), "surface")
    assert design.pins.pitch_m / DESIGN.pins.pitch_m == pytest.approx(factor, abs=0.015)
    assert apart_px["1.000"] > min(apart_px.values())
    assert design.materials == DESIGN.materials


@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("factor", [0.85, 1.04])
def test_pins_at_rest_stay_where_they_are_in_the_image(name, factor):
    design = design_named(name)
    optics = replace(design.optics, zoom=1.01, drift=(0.002, -0.001))
    design = replace(design, optics=optics)
    factor = min(factor, 0.999 * widest_spacing(design))
    wider = with_spacing(design, factor)
    assert np.abs(neutral_px(wider) - neutral_px(design)).max() < 0.02
    assert wider.optics.zoom == 1.01 and wider.optics.drift == (0.002, -0.001)
    # What the lens cannot show of a camera beside the axis, the pins' places absorb.
    assert np.abs(plan_positions(wider.pins) - factor * plan_positions(design.pins)).max() < 0.1e-3
    assert wider.pins.pitch_m == pytest.approx(factor * design.pins.pitch_m)


def test_widest_pins_reach_the_end_of_the_dome():
    lattice = with_spacing(DESIGN, widest_spacing(DESIGN) * (1 - 1e-9))
    assert lattice.pins.rings * lattice.pins.pitch_m == pytest.approx(0.95 * DESIGN.shape.radius_m)
    free = replace(free_sensor(5), pins=replace(free_sensor(5).pins, as_built_m=((0.0, 0.0), (0.01, 0.0), (0.0, -0.015))))
    assert widest_spacing(free) == pytest.approx(0.95 * free.shape.radius_m / 0.015)


@pytest.mark.parametrize("place", [-4.6, -2.3, 0.0, 0.4, 1.3])
def test_lowest_point_of_a_parabola_is_found_downhill(place):
    asked = []

    def value(k):
        asked.append(k)
        return float(np.sqrt(1 + 0.3 * (k - place) ** 2))

    step, found = lowest(value, -5, 1)
    assert step == pytest.approx(min(place, 1))
    assert sorted(asked) == sorted(found) and len(asked) == len(set(asked))
    assert min(found) >= -5 and max(found) <= 1


def test_lowest_point_is_at_the_end_if_values_only_fall():
    assert lowest(lambda k: 10.0 + k, -5, 0)[0] == -5
    assert lowest(lambda k: 10.0 - k, -5, 0)[0] == 0
