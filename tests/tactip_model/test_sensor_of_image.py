"""The nominal design of a sensor of which only the neutral image is known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tactip_twin.tactip_model.design import Optics, Pins
from tactip_twin.tactip_model.design_file import read_design, write_design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import fit_neutral, neutral_px
from tactip_twin.tactip_model.optics import Lens
from tactip_twin.tactip_model.pin_detection import find_blobs
from tactip_twin.tactip_model.pins import LATTICES, neutral_pins, plan_positions
from tactip_twin.tactip_model.presets import NOMINAL
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.sensor_of_image import sensor_of
from tactip_twin.tactip_model.tactile_image import tactile_image

OTHER_LENS = (10.6, 0.075, 0.0018)
"""A lens that no preset has, for a pitch of 3 mm."""


def neutral_image(design):
    """Return the design's own neutral image, binary, 480 px wide."""
    design = replace(design, optics=replace(design.optics, frame_px=720), image=replace(design.image, size_px=480))
    return tactile_image(Raster(design).render(*neutral_pins(design)), replace(design.image, threshold=(121, -5.0)))


def with_optics(pins):
    """Return a tip with these pins, behind another lens off the middle of the image."""
    ratio = pins.pitch_m / 3e-3
    radial = tuple(c * ratio**power for c, power in zip(OTHER_LENS, (1, 3, 5), strict=True))
    return replace(NOMINAL["nominal-127"], pins=pins, optics=Optics(neutral_radius=radial, centre=(0.49, 0.52)))


def of_lattice(layout, rings):
    """Return a hidden tip with a lattice, turned, its pins off the lattice by 0.1 mm."""
    pitch, count = 17.6e-3 / rings, len(LATTICES[layout](rings))
    offsets = np.random.default_rng(rings).normal(0, 0.1e-3, (count, 2))
    pins = Pins(layout, rings, pitch, diameter_m=0.3 * pitch, rim_diameter_m=0.3 * pitch, rotation_deg=7.0)
    return with_optics(replace(pins, as_built_m=tuple(map(tuple, np.clip(offsets, -pitch / 2, pitch / 2).tolist()))))


def of_places(places, pitch=2.5e-3):
    """Return a hidden tip with pins at places (p, 2), m."""
    as_built = tuple(map(tuple, places))
    return with_optics(Pins("free", 7, pitch, diameter_m=0.8e-3, rim_diameter_m=0.8e-3, as_built_m=as_built))


def square_array(side, extent_m):
    """Return the places (side², 2), m, of a square array whose corners are at a distance from the axis."""
    line = np.linspace(-1, 1, side) * extent_m / np.sqrt(2)
    return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)


def spiral(count, extent_m):
    """Return the places (count, 2), m, of a sunflower's seeds."""
    k = np.arange(count) + 0.5
    angle = np.pi * (1 + np.sqrt(5)) * k
    return extent_m * np.sqrt(k / count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)


def assert_places_match(fitted, hidden, within_m):
    """Assert that pins lie where they are, rms, but for the scale, which no neutral image shows."""
    found, true = plan_positions(fitted.pins), plan_positions(hidden.pins)
    found = found * np.linalg.norm(true, axis=1).max() / np.linalg.norm(found, axis=1).max()
    apart = np.linalg.norm(found[:, None] - true[None], axis=2).min(0)
    assert np.sqrt((apart**2).mean()) < within_m


@pytest.mark.parametrize(("layout", "rings"), [("hexagonal", 3), ("hexagonal", 9), ("circular", 6)])
def test_lattice_is_known_from_its_neutral_image(layout, rings):
    hidden = of_lattice(layout, rings)
    design = sensor_of(neutral_image(hidden))
    assert (design.pins.layout, design.pins.rings) == (layout, rings)
    fitted, fit = fit_neutral(design, neutral_image(hidden))
    assert fit.after_px < 0.1 < fit.lattice_px
    assert_places_match(fitted, hidden, 0.2e-3)


@pytest.mark.parametrize("name", NOMINAL)
def test_preset_is_known_from_its_neutral_image(name):
    assert sensor_of(neutral_image(NOMINAL[name])) is NOMINAL[name]


@pytest.mark.parametrize("places", [square_array(7, 17.5e-3), spiral(100, 17.5e-3)], ids=["square", "spiral"])
def test_pins_on_no_lattice_are_where_the_image_shows_them(places):
    hidden = of_places(places)
    design = sensor_of(neutral_image(hidden))
    assert design.pins.layout == "free" and len(design.pins.as_built_m) == len(places)
    seen, true = neutral_px(design), neutral_px(hidden)
    assert np.linalg.norm(seen[:, None] - true[None], axis=2).min(0).max() < 0.5
    assert_places_match(design, hidden, 0.35e-3)
    # The image gives the positions, whatever a design of free pins had before.
    again, fit = fit_neutral(replace(design, pins=replace(design.pins, as_built_m=((0.0, 0.0),))), neutral_image(hidden))
    assert fit.after_px < 0.1 and np.allclose(neutral_px(again), seen, atol=0.1)


def test_specks_away_from_free_pins_or_beside_them_are_no_pins():
    hidden = of_places(square_array(7, 14e-3))
    image = neutral_image(hidden)
    corner = (neutral_px(hidden)[-1] + 0.5) * 480 / 256 + 6
    for place in ((12, 240), (468, 240), corner.round().astype(int).tolist()):
        cv2.circle(image, place, 2, 255, -1)
    assert len(find_blobs(image).centres) == 52
    assert sensor_of(image).name == "free-49" and len(sensor_of(image).pins.as_built_m) == 49


def test_free_pins_that_are_too_small_to_be_counted_are_refused():
    image = neutral_image(of_places(square_array(7, 14e-3)))
    for x, y in (neutral_px(of_places(square_array(3, 9e-3))) + 3) * 480 / 256:
        image[round(y), round(x)] = 255
    with pytest.raises(TactipError, match=r"shows 49 pins, and \d white spots of less than 4 px, .* use larger frames"):
        sensor_of(image)


def test_spots_that_are_no_pins_are_refused():
    image, rng = np.zeros((480, 480), np.uint8), np.random.default_rng(0)
    for x, y in rng.integers(40, 440, (60, 2)):
        cv2.circle(image, (int(x), int(y)), 3, 255, -1)
    with pytest.raises(TactipError, match=r"white spots are unevenly spaced: their distances differ by [3-9]\d %"):
        sensor_of(image)
    with pytest.raises(TactipError, match="must show at least 12 pins, got 0"):
        sensor_of(np.zeros((480, 480), np.uint8))
    with pytest.raises(TactipError, match="must be square"):
        sensor_of(image[:400])


def test_free_pins_have_a_place_in_a_design_file(tmp_path):
    hidden = of_places(square_array(5, 15e-3))
    write_design(tmp_path / "d.json", hidden, {})
    assert read_design(tmp_path / "d.json") == hidden
    # The lens shows the axis in its centre, and free pins as far from it as its radial map says.
    assert Lens(hidden).straight < np.pi / 2
    radius = np.linalg.norm(plan_positions(hidden.pins), axis=1) / hidden.pins.pitch_m
    c1, c3, c5 = hidden.optics.neutral_radius
    expected = c1 * radius + c3 * radius**3 + c5 * radius**5
    centre = np.array(hidden.optics.centre) * 256 - 0.5
    assert np.allclose(np.linalg.norm(neutral_px(hidden) - centre, axis=1), expected, atol=0.3)


def test_free_pins_without_or_beyond_the_dome_are_refused():
    with pytest.raises(TactipError, match="as_built_m must be the positions of the pins, if the layout is free"):
        Pins("free")
    with pytest.raises(TactipError, match=r"as_built_m must be at most 0\.019 m from the tip's axis"):
        of_places([(0.0, 0.0), (0.0195, 0.0)])
