"""Fit of lens, camera and pins to a neutral image, and design files."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import any_materials, read_fast_tip
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.design import Optics, Pins
from tactip_twin.tactip_model.design_file import read_design, read_design_with_drift, write_design, write_fitted_design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import fit_neutral, neutral_px, widest_spacing, with_spacing
from tactip_twin.tactip_model.optics import Lens
from tactip_twin.tactip_model.pin_detection import find_blobs
from tactip_twin.tactip_model.pins import neutral_pins, plan_positions
from tactip_twin.tactip_model.presets import DESIGNS, design_named, load_design
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.sensor_of_image import free_sensor
from tactip_twin.tactip_model.tactile_image import tactile_image


def neutral_image(design, size=360):
    """Return the design's own neutral image, binary."""
    design = replace(design, optics=replace(design.optics, frame_px=720), image=replace(design.image, size_px=size))
    return tactile_image(Raster(design).render(*neutral_pins(design)), replace(design.image, threshold=(121, -5.0)))


@pytest.fixture(scope="module")
def hidden():
    """Return a tip with another lens, a camera off the axis, a rotated layout and pins off the lattice."""
    offsets = np.random.default_rng(3).normal(0, 0.08e-3, (127, 2))
    pins = Pins(rotation_deg=48.0, as_built_m=tuple(map(tuple, offsets.tolist())))
    optics = Optics(neutral_radius=(10.4, 0.06, 0.002), centre=(0.47, 0.53), camera_offset_m=(0.4e-3, -0.3e-3))
    return replace(design_named("nominal-127"), pins=pins, optics=optics)


def test_fit_neutral_recovers_unknown_tip(hidden):
    fitted, fit = fit_neutral(design_named("nominal-127"), neutral_image(hidden))
    assert fit.before_px > 3 and fit.after_px < 0.01
    # 0.11 mm of scatter is 0.4 px in the middle.
    assert fit.after_px < fit.lattice_px < 0.75
    assert np.sqrt(((neutral_px(fitted) - neutral_px(hidden)) ** 2).sum(1).mean()) < 0.25
    # The layout looks the same every 60 degrees.
    assert abs((fitted.pins.rotation_deg - 48.0 + 30) % 60 - 30) < 0.5
    assert np.allclose(fitted.optics.neutral_radius[0], 10.4, rtol=0.02)


def test_fit_neutral_ignores_distant_specks(hidden):
    image = neutral_image(hidden)
    for x, y in [(x, y) for x in (6, 20, 340, 354) for y in (120, 160, 200)]:
        cv2.circle(image, (x, y), 4, 255, -1)
    fitted, fit = fit_neutral(design_named("nominal-127"), image)
    assert len(find_blobs(image).centres) == 139 and fit.lattice_px < 0.75
    assert np.sqrt(((neutral_px(fitted) - neutral_px(hidden)) ** 2).sum(1).mean()) < 0.25


def test_fit_neutral_of_own_image_keeps_design():
    design = design_named("nominal-331")
    fitted, fit = fit_neutral(design, neutral_image(design))
    assert fit.before_px < 0.35 and fit.lattice_px < 0.3
    assert abs(fitted.pins.rotation_deg - design.pins.rotation_deg) < 0.2


def test_fit_neutral_of_other_tip_raises_error(hidden):
    with pytest.raises(TactipError, match=r"must show the 331 pins.*got 127"):
        fit_neutral(design_named("tactip-331"), neutral_image(hidden))
    with pytest.raises(TactipError, match="square"):
        fit_neutral(design_named("nominal-127"), np.zeros((200, 300), np.uint8))


def test_fit_neutral_of_pressed_tip_says_that_it_must_not_touch():
    """No camera that a design may have shows a lattice as the pins of a deep, tilted press."""
    plain = design_named("nominal-331")
    design = replace(plain, materials=replace(plain.materials, kinetic_fraction=0.9))
    pose = from_mm_deg(np.array([[0, 0, -4, 10, 0, 0]]))
    (contact,), _ = FastContacts(read_fast_tip(any_materials("surface")), design).predict(pose, np.zeros((1, 6)))
    pins = Raster(design).render(contact.pin_tips, contact.directions)
    with pytest.raises(TactipError, match=r"no lens shows the pins of the design 'nominal-331' .* use an image of this tip"):
        fit_neutral(design, tactile_image(pins, replace(design.image, size_px=360)))


def test_zoom_and_drift_move_only_the_image(hidden):
    moved = replace(hidden, optics=replace(hidden.optics, zoom=1.02, drift=(0.01, -0.005)))
    centre = np.array(hidden.optics.centre) * 256 - 0.5
    expected = centre + 1.02 * (neutral_px(hidden) - centre) + np.array([0.01, -0.005]) * 256
    assert np.allclose(neutral_px(moved), expected, atol=1e-9)
    assert np.allclose(Lens(moved).coefficients, Lens(hidden).coefficients)


def test_read_design_returns_written_design(hidden, tmp_path):
    write_design(tmp_path / "d.json", hidden, {"by": "a test"})
    assert read_design(tmp_path / "d.json") == hidden == load_design(tmp_path / "d.json")
    assert load_design("tactip-331") == design_named("tactip-331")


def test_fitted_design_file_keeps_camera_drift_apart(hidden, tmp_path):
    warm = replace(hidden, optics=replace(hidden.optics, zoom=1.01, drift=(0.001, -0.002)))
    write_fitted_design(tmp_path / "d.json", warm, {"by": "a test"})
    assert read_design(tmp_path / "d.json") == hidden
    assert read_design_with_drift(tmp_path / "d.json") == warm
    write_design(tmp_path / "e.json", hidden, {})
    with pytest.raises(TactipError, match=r"lacks provenance\.camera_in_use, which only designs fitted to frames have"):
        read_design_with_drift(tmp_path / "e.json")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"format": "tactip-design 2"', '"format": "other"', "is not a design file"),
        ('"format": "tactip-design 2"', '"format": "tactip-design 1"', "fit the design again by `tactip calibrate`"),
        ('"friction": 0', '"fricton": 0', "has no field 'fricton'"),
        ('"name": "nominal-127"', '"name": 3', "must be a string, got 3"),
        ('"friction": 0', '"friction": -1e', "not JSON"),
        ('"pitch_m": 0.003', '"pitch_m": 0.3', "got 0.3"),
        ('"pitch_m": 0.003', '"pitch_m": "wide"', "pitch_m must be a number, got 'wide'"),
    ],
)
def test_read_design_of_invalid_file_names_field(tmp_path, old, new, words):
    path = tmp_path / "d.json"
    write_design(path, design_named("nominal-127"), {})
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(TactipError, match=words):
        read_design(path)


def test_load_design_of_missing_file_lists_presets(tmp_path):
    with pytest.raises(TactipError, match="presets are tactip-127, tactip-331, nominal-127, nominal-331"):
        load_design(tmp_path / "none.json")


def test_pin_offsets_of_wrong_count_or_size_raise_error():
    design = design_named("nominal-127")
    with pytest.raises(TactipError, match="must be 127, one per pin, or 0, got 1"):
        neutral_pins(replace(design, pins=replace(design.pins, as_built_m=((0.0, 0.0),))))
    with pytest.raises(TactipError, match="as_built_m"):
        Pins(as_built_m=((0.01, 0.0),))


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
    plain = design_named("nominal-127")
    lattice = with_spacing(plain, widest_spacing(plain) * (1 - 1e-9))
    assert lattice.pins.rings * lattice.pins.pitch_m == pytest.approx(0.95 * plain.shape.radius_m)
    free = replace(free_sensor(5), pins=replace(free_sensor(5).pins, as_built_m=((0.0, 0.0), (0.01, 0.0), (0.0, -0.015))))
    assert widest_spacing(free) == pytest.approx(0.95 * free.shape.radius_m / 0.015)
